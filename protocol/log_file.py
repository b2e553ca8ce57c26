# SPDX-License-Identifier: MIT
"""Messages of a log by kind and object, above the chunks of its files (log_chunks.py, log_pieces.py)."""

from __future__ import annotations

import contextlib
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple, Self

from mcap.records import Channel, McapRecord, Message

from protocol.log_chunks import BadLog, ChunkFile, NoFile
from protocol.log_pieces import later_pieces

CHUNKS = 8  # kept unpacked, about 1 MiB each
KEPT_EVERY = 16  # steps: so many less one records of an object may be left out in a row where the log could not follow
OPEN = 64  # pieces that stay open, so that they can be read though a recorder removes them; others while they are read


class LogMessage(NamedTuple):
    """A message of the topic /KIND or /KIND/OBJECT, not decoded.

    offset: of its chunk, in all pieces one after another [bytes]. number: of the message among the chunk's records.
    """

    topic: str
    kind: str
    object: str
    time: int  # ns
    data: bytes
    offset: int
    number: int


@dataclass
class LogFile(ChunkFile):
    """The messages of one log, of all its pieces; a context manager. Without the first piece it begins at the next."""

    _chunks: OrderedDict[int, list[McapRecord]] = field(default_factory=OrderedDict)  # by offset, the last used last
    later: list[ChunkFile] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)  # between pieces, one sentence each, after `messages`

    @classmethod
    def open(cls, path: Path) -> Self:
        """Opens a log. Raises BadLog if there is none, or it is no MCAP file."""
        log, pieces = cls._first(path)
        run = log.origin().get("run")
        for piece in pieces if run else ():
            with contextlib.suppress(BadLog):  # one that was begun when the disk was full has no beginning
                file = ChunkFile.open(piece)
                if ours := file.origin().get("run") == run:
                    log.later.append(file)
                if not ours or len(log.later) > OPEN:
                    file.close()
        return log

    @classmethod
    def _first(cls, path: Path) -> tuple[Self, list[Path]]:
        """Opens the first piece that is there and can be read; returns it and the paths of those after it."""
        pieces = [piece for _, piece in later_pieces(path)]  # a recorder may remove some of them until they are opened
        try:
            return super().open(path), pieces
        except NoFile:
            for k, piece in enumerate(pieces):
                with contextlib.suppress(BadLog):
                    return super().open(piece), pieces[k + 1 :]
            raise

    def _pieces(self) -> list[ChunkFile]:
        return [self, *self.later]

    def messages(self, progress: Callable[[int], None] = lambda _: None) -> Iterator[LogMessage]:
        """Yields the messages in file order; `progress` gets the offset reached.

        Raises BadLog before the first message unless the file is a log of this protocol version.
        """
        base, piece_before = 0, 0
        self.gaps.clear()
        for k, piece in enumerate(self._pieces()):
            topics: dict[int, tuple[str, str, str]] = {}
            place, repeated = _place(piece)
            if k > 0 and place > piece_before + 1:
                numbers = f"{piece_before + 1} to {place - 1}" if place > piece_before + 2 else f"{place - 1}"
                self.gaps.append(f"{piece.path}: before it piece {numbers} of the log is missing, or cannot be read")
            skip = repeated if k > 0 and place == piece_before + 1 else 0
            for offset, records in piece.scan(lambda reached, base=base: progress(base + reached)):  # type: ignore[misc]
                piece.check_origin()
                if piece.problems:  # what comes twice is whole, and at the beginning: it may be what is left out
                    skip = 0
                for number, record in enumerate(records):
                    if isinstance(record, Channel):
                        _, kind, name = [*record.topic.split("/", 2), "", ""][:3]
                        topics[record.id] = record.topic, kind, name
                    elif isinstance(record, Message):
                        if skip > 0:
                            skip -= 1
                            continue
                        topic = topics.get(record.channel_id, ("", "", ""))
                        yield LogMessage(*topic, record.log_time, record.data, base + offset, number)
            piece.check_origin()
            if k > OPEN:
                piece.close()
            base, piece_before = base + piece.size, place

    @property
    def whole(self) -> bool:
        """True if all pieces from the first that is there were closed by their writer and every block of them could be
        read; after `messages`."""
        return not self.gaps and all(piece.complete and not piece.problems for piece in self._pieces())

    @property
    def begins_late(self) -> bool:
        """True if the first piece that is there is not the first that was written."""
        return _place(self)[0] > 1

    def notes(self) -> list[str]:
        """Returns one sentence for each gap, after `messages`."""
        return [*self.gaps, *(note for piece in self._pieces() for note in ChunkFile.notes(piece))]

    def close(self) -> None:
        for piece in self._pieces():
            piece.stream.close()

    def data(self, offset: int, number: int) -> bytes:
        """Returns the data of a message that `messages` has yielded. Raises BadLog if its file was changed since."""
        if offset not in self._chunks:
            while len(self._chunks) >= CHUNKS:
                self._chunks.popitem(last=False)
            pieces = self._pieces()
            begins = list(accumulate((piece.size for piece in pieces[:-1]), initial=0))
            k = bisect_right(begins, offset) - 1
            self._chunks[offset] = pieces[k].chunk(offset - begins[k])
            if k > OPEN:
                pieces[k].close()
        self._chunks.move_to_end(offset)
        records = self._chunks[offset]
        record = records[number] if number < len(records) else None
        if not isinstance(record, Message):
            raise BadLog(f"{self.path}: the file was changed or removed since it was opened")
        return record.data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _place(piece: ChunkFile) -> tuple[int, int]:
    """Returns (number of a piece, messages at its start that repeat earlier ones); a file without them is the first."""
    origin = piece.origin()
    number, repeated = origin.get("piece", ""), origin.get("repeated", "")
    return int(number) if number.isdecimal() else 1, int(repeated) if repeated.isdecimal() else 0
