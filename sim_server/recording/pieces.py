# SPDX-License-Identifier: MIT
"""The files of a log, one after another (protocol/log_pieces.py): by size and time, and after one that broke off."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message

from protocol.log_pieces import later_pieces, piece_path
from sim_server.errors import InputError
from sim_server.recording.file_lock import is_locked
from sim_server.recording.mcap_file import McapFile, is_written
from sim_server.recording.rotation import Kept, Rotation, remove_earlier

ROOM = 2 << 20  # bytes free beside what each file begins with, for a new file after the disk was full


class Record(NamedTuple):
    """A message to be written. Times in ns.

    repeat: place of what each file begins with, as the newest mesh of an object; empty: it is in one file only
    """

    topic: str
    kind: type[Message]
    log_time: int  # of simulation
    publish_time: int  # Unix time
    sequence: int
    data: bytes
    repeat: str = ""


class Repeated:
    """What each file begins with: the newest scene, meshes and obstacles."""

    def __init__(self) -> None:
        self._records: dict[str, Record] = {}

    def note(self, record: Record) -> None:
        """Takes the place of an earlier record; a whole mesh that of what cuts changed of the one before, too."""
        if record.repeat:
            for place in (record.repeat, f"{record.repeat}/cut"):
                self._records.pop(place, None)
            self._records[record.repeat] = record

    def records(self) -> list[Record]:
        """Returns them in the order in which they came."""
        return list(self._records.values())


class Pieces:
    """Writes records, and begins a new file when one is due. Raises OSError; InputError if the first cannot be made."""

    def __init__(self, path: Path, compression: str, overwrite: bool, rotation: Rotation):
        self._path, self._compression, self._rotation = path, compression, rotation
        self._run, self._number = secrets.token_hex(8), 1
        self._kept, self.repeated = Kept(rotation), Repeated()
        refuse_written(path)
        self._file = McapFile(path, compression, overwrite, self._origin(0))
        self._regular = self._file.regular
        self._first: int | None = None
        if self._regular:
            self._first = self._file.duplicate()  # locks the whole log while later files are written
            remove_earlier(path)
        self._begun, self._records = time.monotonic(), 0
        self._ended_bytes = self._file_size = 0  # of all files before, of the last one that was ended
        self._noted: dict[str, int] = {}  # notes of all files before

    def _origin(self, repeated: int) -> dict[str, str]:
        return {"run": self._run, "piece": str(self._number), "repeated": str(repeated)}

    @property
    def path(self) -> Path:
        """Path of the file in progress."""
        return piece_path(self._path, self._number)

    @property
    def bytes_written(self) -> int:
        """Bytes written to all files, also to those that were removed."""
        return self._ended_bytes + self._file.size

    def write(self, record: Record) -> None:
        """Appends a record."""
        self.repeated.note(record)
        self._put(record)

    def _put(self, r: Record) -> None:
        self._file.write(r.topic, r.kind, r.log_time, r.publish_time, r.sequence, r.data)
        self._records += 1

    def flush(self) -> None:
        """Writes all to the operating system."""
        self._file.flush()

    def look(self, notes: dict[str, int]) -> None:
        """Checks that the file is still there, begins a new one if it is due, keeps the budget. notes: as `finish`"""
        self._file.check_exists()
        if self._regular and self._records and self._rotation.due(self._file.size, time.monotonic() - self._begun):
            ended = self._file.duplicate()  # keeps the log locked until the next file is
            try:
                self.finish(notes)
                self._kept.add(self.path, self._file_size)
                self._begin(self.repeated.records(), repeats=True)
            finally:
                os.close(ended)
        self._kept.keep_budget(self._file.size)

    def finish(self, notes: dict[str, int]) -> None:
        """Ends the file. notes: counts over all files so far; each file has its own part"""
        own = {name: count - self._noted.get(name, 0) for name, count in notes.items()}
        self._file_size = self._file.finish({name: str(count) for name, count in own.items()})
        self._noted = dict(notes)
        self._ended_bytes += self._file_size

    def abandon(self) -> None:
        """Leaves a file that cannot be written; what was flushed stays readable. One that was ended stays as it is."""
        if self._file.closed:
            return
        size = self._file.size
        self._file.abandon()
        self._ended_bytes += size
        self._kept.add(self.path, size)

    def close(self) -> None:
        """Gives the log free for others. A second call does nothing."""
        first, self._first = self._first, None
        if first is not None:
            os.close(first)

    def may_go_on(self, first: Sequence[Record]) -> bool:
        """True if a new file that begins with these may be begun after one was abandoned: there is room."""
        try:
            free = shutil.disk_usage(self._path.parent).free
        except OSError:
            return False
        return self._regular and free >= ROOM + 2 * sum(len(record.data) for record in first)

    def go_on(self, first: Sequence[Record]) -> None:
        """Begins a new file with these after one was abandoned. Raises OSError or InputError, and leaves none then."""
        number = self._number
        try:
            self._begin(first, repeats=False)
        except OSError:
            self._file.abandon()
            with contextlib.suppress(OSError):
                self.path.unlink()
            self._number = number
            raise

    def _begin(self, first: Sequence[Record], repeats: bool) -> None:
        """repeats: what it begins with is in the file before, too, and nothing is missing between them"""
        self._number += 1
        try:
            self._file = McapFile(self.path, self._compression, True, self._origin(len(first) if repeats else 0))
        except InputError:
            self._number -= 1
            raise
        self._begun, self._records = time.monotonic(), 0
        for record in first:
            self._put(record)
        self._file.flush()
        self._records = 0


def refuse_written(path: Path) -> None:
    """Raises InputError if another process writes a later file of a log; its first one need not be there any more."""
    looked: list[tuple[int, Path]] | None = None
    while looked != (now := later_pieces(path)):  # it may have begun the next file meanwhile
        looked = now
        for _, piece in reversed(now):
            if is_locked(piece):
                raise InputError(is_written(piece))
