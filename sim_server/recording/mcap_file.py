# SPDX-License-Identifier: MIT
"""Writes MCAP files: chunks of 1 MiB, one embedded protobuf schema per message type."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from protocol.channels import PROTOCOL
from sim_server.errors import InputError
from sim_server.recording.file_lock import lock

CHUNK_BYTES = 1 << 20
PROFILE = "warpfactor"
COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}


class McapFile:
    """Writes a file; registers channels and schemas at their first message. Raises InputError if it cannot be made.

    origin: what is written at its start beside the version of the protocol
    """

    def __init__(self, path: Path, compression: str, overwrite: bool, origin: dict[str, str] | None = None) -> None:
        if compression not in COMPRESSIONS:
            raise InputError(f"recording: compression = {compression!r}: allowed are {', '.join(COMPRESSIONS)}")
        self._stream = _opened(path, overwrite)
        found = os.fstat(self._stream.fileno())
        self.regular = stat.S_ISREG(found.st_mode)
        self._linked = found.st_nlink > 0  # some file systems do not count links
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=COMPRESSIONS[compression])
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}
        self._writer.start(profile=PROFILE)
        self._writer.add_metadata("warpfactor", {"protocol": str(PROTOCOL), **(origin or {})})

    def write(
        self, topic: str, kind: type[Message], log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Appends one serialized message; times in ns. Raises OSError."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic, kind)
        self._writer.add_message(channel, log_time, data, publish_time, sequence)

    def flush(self) -> None:
        """Ends the chunk in progress and writes all to the operating system. Raises OSError."""
        self._writer.flush()
        self.check_exists()

    def check_exists(self) -> None:
        """Raises OSError if the file was removed: its contents would be lost when it is closed."""
        if self._linked and os.fstat(self._stream.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, "the file was removed or replaced")

    def finish(self, notes: dict[str, str]) -> int:
        """Writes `notes` and the index, and closes; returns the bytes of the file. Raises OSError."""
        self._writer.add_metadata("recorder", notes)
        self._writer.finish()
        self.check_exists()
        size = self.size
        self._stream.close()
        return size

    @property
    def size(self) -> int:
        """Bytes given to the file so far; those of the chunk in progress are not among them. 0 once it is closed."""
        return 0 if self._stream.closed else self._stream.tell()

    @property
    def closed(self) -> bool:
        """True once it was ended or abandoned."""
        return self._stream.closed

    def abandon(self) -> None:
        """Closes the file without an index after an error; flushed chunks stay readable."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.close()

    def duplicate(self) -> int:
        """Returns another descriptor of the file, which keeps it locked after its end."""
        return os.dup(self._stream.fileno())

    def _register(self, topic: str, kind: type[Message]) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = register_schema(self._writer, kind)
        return self._writer.register_channel(topic, MessageEncoding.Protobuf, self._schemas[kind])


def _opened(path: Path, overwrite: bool) -> BinaryIO:
    """Opens a file to be written anew, and locks it before anything in it is lost. Raises InputError."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | (0 if overwrite else os.O_EXCL), 0o666)
    except FileExistsError:
        raise InputError(f"{path}: the file exists: remove it or choose another name for the log") from None
    except OSError as error:
        raise InputError(f"{path}: a log cannot be written there: {error.strerror}") from None
    stream = os.fdopen(descriptor, "wb")
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            if not lock(descriptor):
                raise InputError(is_written(path))
            os.ftruncate(descriptor, 0)
    except OSError as error:
        stream.close()
        raise InputError(f"{path}: a log cannot be written there: {error.strerror}") from None
    except InputError:
        stream.close()
        raise
    return stream


def is_written(path: Path) -> str:
    """Says that another process writes a log."""
    return f"{path}: another server records to this file now; choose another name for the log, or stop that server"
