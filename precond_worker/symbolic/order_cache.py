# SPDX-License-Identifier: MIT
"""Orders of elimination on disk: a mesh is ordered once per machine, not once per start of a worker.

METIS takes a third of a second for 98,304 tetrahedra, seconds for a million. A file is named after the digest of the
graph and of what orders it. What is read is checked: a file of somebody else, one that others may write to, or one that
holds no permutation of the right size counts as not there. It could cost time, and never an answer.
"""

import contextlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xxhash

from precond_worker.arrays import Int32, Int64

MOST_BYTES = 256 << 20  # of all files together; the ones that were used longest ago are deleted
LEAST_NODES = 2000  # of a graph that is kept: small ones are ordered faster than a file is written
SUFFIX = ".order"

Order = Callable[[Int32, Int32], Int64]


def cached(order: Order, name: str, start: Int32, neighbours: Int32) -> Int64:
    """Returns order(start, neighbours), from the disk if it is there. name: of what orders, with its version."""
    if len(start) <= LEAST_NODES:
        return order(start, neighbours)
    digest = xxhash.xxh3_128(name.encode())
    for array in (start, neighbours):
        digest.update(len(array).to_bytes(8, "little") + np.ascontiguousarray(array).tobytes())
    path = folder() / f"{digest.hexdigest()}{SUFFIX}"
    found = _read(path, len(start) - 1)
    if found is None:
        found = order(start, neighbours)
        with contextlib.suppress(OSError):  # a full disk, or a folder that is not ours
            _write(path, found)
    return found


def folder() -> Path:
    """Returns the folder of the files: orders in that of compiled kernels (WARPFACTOR_CACHE)."""
    given = os.environ.get("WARPFACTOR_CACHE")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (Path(given) if given else home / "warpfactor") / "orders"


def _read(path: Path, nodes: int) -> Int64 | None:
    """Returns the order in a file; None if there is no such file, or it cannot be trusted."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
            info = os.fstat(file.fileno())
            others = stat.S_IWGRP | stat.S_IWOTH
            if not stat.S_ISREG(info.st_mode) or info.st_uid != os.geteuid() or info.st_mode & others:
                return None
            if info.st_size != 4 * nodes:
                return None
            order = np.frombuffer(file.read(), np.int32).astype(np.int64)
            os.utime(file.fileno())  # used now
    except OSError:
        return None
    in_range = len(order) == nodes and order.min() >= 0 and order.max() < nodes
    return order if in_range and (np.bincount(order, minlength=nodes) == 1).all() else None


def _write(path: Path, order: Int64) -> None:
    """Writes a file whole or not at all, and deletes old ones beyond MOST_BYTES. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:  # mode 0600
        try:
            file.write(order.astype(np.int32).tobytes())
            file.flush()
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise
    files = sorted(path.parent.glob(f"*{SUFFIX}"), key=lambda p: p.stat().st_mtime, reverse=True)
    total = np.cumsum([p.stat().st_size for p in files])
    for old in [p for p, size in zip(files, total.tolist(), strict=True) if size > MOST_BYTES]:
        old.unlink(missing_ok=True)
