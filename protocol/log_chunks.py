# SPDX-License-Identifier: MIT
"""Reads an MCAP file that may be cut off, damaged or hostile: chunk by chunk, every size checked before use.

The readers of the mcap package need the index at the end of the file, or raise at the first damaged byte; a log whose
server was killed has no index, and everything up to the last complete chunk can be read.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Self

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata
from mcap.writer import MCAP0_MAGIC

from protocol.channels import OLDEST_LOG, PROTOCOL

RECORD_LIMIT = 1 << 29  # bytes of one record, compressed or not; twice the limit of a mesh on the wire
CHUNK_RECORDS = 1 << 18  # records of one chunk; ten times those of the 1 MiB that a recorder fills
PIECE = 1 << 20  # bytes unpacked at a time
_HEAD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_READ = (Opcode.CHANNEL, Opcode.MESSAGE)
PROFILE = "warpfactor"
BROKEN = (
    McapError, struct.error, UnicodeDecodeError, ValueError, RuntimeError, EOFError, OverflowError, zstandard.ZstdError,
)  # fmt: skip


class BadLog(ValueError):
    """The file is no log, or one of another protocol version; the text names the file."""


class NoFile(BadLog):
    """There is no such file."""


@dataclass
class ChunkFile:
    """The records of one file. `problems` and `complete` are known once `scan` has ended.

    Raises NoFile from `open` if there is no such file, BadLog if it is no MCAP file.
    """

    path: Path
    stream: BinaryIO
    size: int  # bytes
    header: Header = field(default_factory=lambda: Header("", ""))
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    complete: bool = False  # the end mark was seen: the writer closed the file
    announced: int | None = None  # number of messages according to the writer
    _inode: int = 0

    def __post_init__(self) -> None:
        self._inode = os.fstat(self.stream.fileno()).st_ino

    @classmethod
    def open(cls, path: Path) -> Self:
        """Opens a file. Raises NoFile if there is none, BadLog if it is no MCAP file."""
        try:
            stream = path.open("rb")
            size = os.fstat(stream.fileno()).st_size
            magic = stream.read(len(MCAP0_MAGIC))
        except OSError as error:
            kind = NoFile if error.errno == errno.ENOENT else BadLog
            raise kind(f"{path}: cannot be read: {error.strerror}") from None
        if magic != MCAP0_MAGIC:
            stream.close()
            raise BadLog(
                f"{path}: {'an empty file' if size == 0 else 'not an MCAP file'}, a log of sim-server is wanted"
            )
        return cls(path, stream, size)

    def close(self) -> None:
        """Closes the file; it is opened again where it is read again."""
        self.stream.close()

    def _read(self, offset: int, count: int) -> bytes:
        """Returns bytes of the file. Raises OSError, also if another file has its name by now."""
        if self.stream.closed:
            stream = self.path.open("rb")
            if os.fstat(stream.fileno()).st_ino != self._inode:
                stream.close()
                raise OSError(errno.ESTALE, "the file was replaced")
            self.stream = stream
        self.stream.seek(offset)
        return self.stream.read(count)

    def scan(self, progress: Callable[[int], None] = lambda _: None) -> Iterator[tuple[int, list[McapRecord]]]:
        """Yields (byte offset, records) of every readable chunk in file order; `progress` gets the offset reached."""
        messages = 0
        for offset, opcode, body in self._records():
            progress(offset)
            try:
                if opcode == Opcode.HEADER:
                    self.header = Header.read(body)
                elif opcode == Opcode.METADATA:
                    record = Metadata.read(body)
                    self.metadata[record.name] = record.metadata
                elif opcode == Opcode.CHUNK:
                    records = unpack(Chunk.read(body))
                    messages += sum(isinstance(record, Message) for record in records)
                    yield offset, records
            except BROKEN as error:
                self.problems.append(f"the block at byte {offset} is damaged and left out ({error})")
        if not self.problems and self.announced not in (None, messages):
            self.problems.append(f"{messages} messages were found, {self.announced} written: a block is damaged")
        progress(self.size)

    def check_origin(self) -> None:
        """Raises BadLog unless it is a log of sim-server of a readable version. Before messages are decoded."""
        if self.problems and not self.metadata:
            raise BadLog(f"{self.path}: nothing readable: {self.problems[0]}")
        if self.header.profile != PROFILE:
            raise BadLog(
                f"{self.path}: an MCAP file, but not a log of sim-server "
                f"(profile {self.header.profile!r}, expected {PROFILE!r})"
            )
        version = self.metadata.get("warpfactor", {}).get("protocol", "unknown")
        if version not in [str(number) for number in range(OLDEST_LOG, PROTOCOL + 1)]:
            readable = f"versions {OLDEST_LOG} to {PROTOCOL}"
            raise BadLog(f"{self.path}: a log of protocol version {version}; this program reads {readable}")

    def origin(self) -> dict[str, str]:
        """Returns what the writer says of the file at its start; empty if it is not there."""
        if "warpfactor" not in self.metadata:
            problems, self.problems = self.problems, []
            for _, opcode, body in self._records():
                if opcode == Opcode.METADATA:
                    with contextlib.suppress(*BROKEN):
                        record = Metadata.read(body)
                        self.metadata.setdefault(record.name, record.metadata)
                if opcode != Opcode.HEADER:
                    break
            self.problems, self.complete = problems, False
        return self.metadata.get("warpfactor", {})

    def notes(self) -> list[str]:
        """Returns one sentence for each gap, after `scan`."""
        notes = [f"{self.path}: {problem}" for problem in self.problems]
        for name, count in self.metadata.get("recorder", {}).items():
            if count != "0":
                notes.append(f"{self.path}: the recorder could not keep up: {name.replace('_', ' ')}: {count}")
        return notes

    def chunk(self, offset: int) -> list[McapRecord]:
        """Returns the records of the chunk at `offset`, one that `scan` has yielded.

        Raises BadLog if it is not there any more: the file was changed or removed since.
        """
        try:
            opcode, length = _HEAD.unpack(self._read(offset, _HEAD.size))
            if opcode != Opcode.CHUNK or length > RECORD_LIMIT:
                raise ValueError("another block is there")
            return unpack(Chunk.read(ReadDataStream(BytesIO(self._read(offset + _HEAD.size, length)))))
        except (OSError, *BROKEN) as error:
            raise BadLog(
                f"{self.path}: the block at byte {offset} cannot be read again, the file was changed or removed "
                f"since it was opened ({error})"
            ) from None

    def _statistics(self, offset: int) -> int | None:
        """Returns the number of messages in the summary that begins at `offset`; None without a summary."""
        while offset + _HEAD.size <= self.size:
            opcode, length = _HEAD.unpack(self._read(offset, _HEAD.size))
            if opcode == Opcode.STATISTICS and length >= 8 and offset + _HEAD.size + 8 <= self.size:
                return int.from_bytes(self._read(offset + _HEAD.size, 8), "little")
            if opcode in (0, Opcode.FOOTER) or length > RECORD_LIMIT:
                return None
            offset += _HEAD.size + length
        return None

    def _records(self) -> Iterator[tuple[int, int, ReadDataStream]]:
        offset = len(MCAP0_MAGIC)
        try:
            while offset + _HEAD.size <= self.size:
                opcode, length = _HEAD.unpack(self._read(offset, _HEAD.size))
                body = offset + _HEAD.size
                if opcode == Opcode.DATA_END:
                    self.complete = True
                    self.announced = self._statistics(body + length)
                    return
                if opcode == 0 or length > RECORD_LIMIT:
                    self.problems.append(f"damaged at byte {offset}: nothing after that is read")
                    return
                if body + length > self.size:
                    break
                wanted = opcode in (Opcode.HEADER, Opcode.METADATA, Opcode.CHUNK)
                yield offset, opcode, ReadDataStream(BytesIO(self._read(body, length) if wanted else b""))
                offset = body + length
        except (OSError, struct.error) as error:  # of a disk or network, or it was removed or cut
            self.problems.append(f"cannot be read from byte {offset} on: {getattr(error, 'strerror', None) or error}")
            return
        self.problems.append(
            f"ends at byte {self.size} without an end mark: the server was killed, or is still recording"
        )


def unpack(chunk: Chunk) -> list[McapRecord]:
    """Checks size and checksum of a chunk and returns its channels and messages; raises one of BROKEN."""
    size = chunk.uncompressed_size
    if size > RECORD_LIMIT:
        raise ValueError(f"a chunk of {size} bytes, at most {RECORD_LIMIT} are read")
    data, at = bytearray(), 0
    places: list[tuple[int, int, int]] = []  # type, first byte and length of each record
    for piece in _pieces(chunk):  # parsed piece by piece, so that a malformed chunk is not unpacked to its end
        data += piece
        if len(data) > size:
            break
        while at + _HEAD.size <= len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            if opcode == 0 or at + _HEAD.size + length > size or len(places) == CHUNK_RECORDS:
                raise ValueError(f"no records from byte {at} of a chunk on")
            at += _HEAD.size
            places.append((opcode, at, length))
            at += length
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes instead of {size}")
    if at != size:
        raise ValueError(f"no records from byte {at} of a chunk on")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("wrong checksum")
    return [_record(opcode, bytes(data[b : b + n])) for opcode, b, n in places if opcode in _READ]


def _pieces(chunk: Chunk) -> Iterator[bytes]:
    """Yields the content of a chunk, PIECE bytes at a time, up to one byte more than its stated size."""
    size = chunk.uncompressed_size
    if chunk.compression == "":
        yield chunk.data
        return
    if chunk.compression == "lz4":
        stream = lz4.frame.LZ4FrameFile(BytesIO(chunk.data))
    elif chunk.compression == "zstd":
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data)
    else:
        raise ValueError(f"compression {chunk.compression!r} is not known")
    done = 0
    while done <= size and (piece := stream.read(min(PIECE, size + 1 - done))):
        done += len(piece)
        yield piece


def _record(opcode: int, body: bytes) -> McapRecord:
    if opcode == Opcode.CHANNEL:
        return Channel.read(ReadDataStream(BytesIO(body)))
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
    return Message(channel, log_time, body[_MESSAGE.size :], publish_time, sequence)
