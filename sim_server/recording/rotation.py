# SPDX-License-Identifier: MIT
"""When a log goes on in a new file, and which of its files are kept (`--record-rotate`, `--record-keep`)."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from protocol.log_pieces import later_pieces, size_of_file
from sim_server.errors import InputError
from sim_server.recording.file_lock import is_locked
from sim_server.scene.sizes import SIZES, TIMES, measure

LEAST_BYTES, LEAST_SECONDS = 10**6, 1.0


@dataclass(frozen=True)
class Rotation:
    """bytes, seconds: after which a new file is begun. keep: bytes of all files together. None: no limit

    earlier: files of earlier logs that count to `keep`, oldest first, but for those that another server writes
    """

    bytes: float | None = None
    seconds: float | None = None
    keep: float | None = None
    earlier: tuple[Path, ...] = ()

    @classmethod
    def of_options(cls, rotate: Sequence[str], keep: str | None) -> Rotation:
        """Reads --record-rotate (sizes and times, of each the least) and --record-keep. Raises InputError."""
        sizes, times = [], []
        for text in rotate:
            size, time = measure(text, SIZES), measure(text, TIMES)
            if size is not None and size >= LEAST_BYTES:
                sizes.append(size)
            elif time is not None and time >= LEAST_SECONDS:
                times.append(time)
            else:
                raise InputError(
                    f"--record-rotate {text}: allowed is a size of at least 1MB, as 500MB or 2GiB, or a time of at "
                    "least 1s, as 10min, 1h or 1d"
                )
        if keep is None:
            return cls(min(sizes, default=None), min(times, default=None))
        kept = measure(keep, SIZES)
        if kept is None or kept < 2 * LEAST_BYTES:
            raise InputError(f"--record-keep {keep}: allowed is a size of at least 2MB, as 20GB")
        if not rotate:
            raise InputError("--record-keep goes with --record-rotate: only whole files are removed")
        return cls(min([*sizes, kept / 2]), min(times, default=None), kept)

    def due(self, size: int, age: float) -> bool:
        """True if a file of this size and age is to be ended [bytes, s]."""
        return (self.bytes is not None and size >= self.bytes) or (self.seconds is not None and age >= self.seconds)


class Kept:
    """The files that were ended, those of earlier logs first; removes the oldest of them to keep the budget."""

    def __init__(self, rotation: Rotation):
        self._rotation = rotation
        ours = (path for path in rotation.earlier if _is_log(path) and not is_locked(path))
        self._ended: deque[tuple[Path, int]] = deque((path, size_of_file(path)) for path in ours)
        self.removed = 0

    def add(self, path: Path, size: int) -> None:
        """Adds a file that was ended."""
        self._ended.append((path, size))

    def keep_budget(self, current: int) -> None:
        """Removes files until all fit the budget. current: bytes of the file in progress"""
        total = current + sum(size for _, size in self._ended)
        while self._rotation.keep is not None and self._ended and total > self._rotation.keep:
            path, size = self._ended.popleft()
            with contextlib.suppress(OSError):  # somebody has moved it away
                path.unlink()
            self.removed += 1
            total -= size


def remove_earlier(path: Path) -> None:
    """Removes later pieces of an earlier log of this name, which is to be replaced. Other files are left alone."""
    for _, piece in later_pieces(path):
        if _is_log(piece):
            with contextlib.suppress(OSError):
                piece.unlink()


def _is_log(path: Path) -> bool:
    """True of a file that is empty or begins as a log does."""
    try:
        with path.open("rb") as file:
            return file.read(8) in (b"\x89MCAP0\r\n", b"")
    except OSError:
        return False
