# SPDX-License-Identifier: MIT
"""Files that save time at the next start, in folders of cache_folder().

Who reads one checks what is in it. A file of somebody else, or one that others may write to, counts as not there.
"""

import contextlib
import os
import stat
import tempfile
from pathlib import Path

import numpy as np

from protocol.process.cache_folder import remove_stale, unfinished


def read_kept(path: Path, most: int) -> bytes | None:
    """Returns what is in a file and marks it as used; None if there is none of at most so many bytes that can be
    trusted."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK  # a pipe would be waited for
    try:
        with open(os.open(path, flags), "rb") as file:
            info = os.fstat(file.fileno())
            others = stat.S_IWGRP | stat.S_IWOTH
            if not stat.S_ISREG(info.st_mode) or info.st_uid != os.geteuid() or info.st_mode & others:
                return None
            if info.st_size > most:
                return None
            os.utime(file.fileno())
            return file.read(most + 1)
    except OSError:
        return None


def keep(path: Path, data: bytes, most: int) -> None:
    """Writes a file whole or not at all, and deletes those of its kind that were used longest ago beyond `most` bytes.
    A full disk, or a folder that is not ours, costs nothing but the file."""
    with contextlib.suppress(OSError):
        _write(path, data)
        files = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda p: p.stat().st_mtime, reverse=True)
        total = np.cumsum([p.stat().st_size for p in files])
        for old in [p for p, size in zip(files, total.tolist(), strict=True) if size > most]:
            old.unlink(missing_ok=True)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    remove_stale(path.parent)
    begin, end = f"{path.stem}.", unfinished(path).name.removeprefix(path.stem)
    # with a name of its own, as threads may write the same file, and mode 0600
    with tempfile.NamedTemporaryFile(prefix=begin, suffix=end, dir=path.parent, delete=False) as file:
        try:
            file.write(data)
            file.flush()
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise
