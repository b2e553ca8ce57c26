# SPDX-License-Identifier: MIT
"""Where files are kept that save time at the next start: compiled kernels, orders, patterns, meshes.

A process that is killed leaves unfinished ones behind, which go a day later.
"""

import contextlib
import os
import re
import stat
import time
from functools import cache
from pathlib import Path

STALE = 86400.0  # s without a write after which nobody is at work on a file
NAME = re.compile(r".+\.\d+\.tmp|tmp[a-z0-9_]{8}")  # the second: of earlier versions


def cache_folder() -> Path:
    """$WARPFACTOR_CACHE, else $XDG_CACHE_HOME/warpfactor, else ~/.cache/warpfactor."""
    if folder := os.environ.get("WARPFACTOR_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpfactor"


def unfinished(path: Path) -> Path:
    """Returns where this process writes a file before it gets its name; others may make the same one."""
    return path.with_suffix(f".{os.getpid()}.tmp")


@cache
def remove_stale(folder: Path) -> None:
    """Removes this user's unfinished files that nobody has written to for a day, once in a process."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for path in [entry.path for entry in entries if NAME.fullmatch(entry.name)]:
            with contextlib.suppress(OSError):
                info = os.lstat(path)
                own = not hasattr(os, "geteuid") or info.st_uid == os.geteuid()
                if own and stat.S_ISREG(info.st_mode) and time.time() - info.st_mtime > STALE:
                    os.unlink(path)
