# SPDX-License-Identifier: MIT
"""Limits of shared memory: whether this process may create and lock what it needs.

zenoh locks every shared memory pool it creates or reads. A reader over its limit loses messages without an error
(eclipse-zenoh/zenoh issue 2788), so shared memory is switched off beforehand where the limit is too low.
"""

import os
from pathlib import Path

SHM = Path("/dev/shm")
POOL_LIMIT = 1 << 30  # bytes of all slots of a server
SLOT_SHARE = 4  # a larger part of all slots than a SLOT_SHARE-th is not lent for one factor: it goes in parts
METADATA = 64 << 20  # bytes for segments of zenoh's own
CAP_IPC_LOCK = 14


def may_lock_anything() -> bool:
    """True if this process has CAP_IPC_LOCK, so that no limit applies."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return False
    effective = next((line.split()[1] for line in status.splitlines() if line.startswith("CapEff:")), "0")
    return bool(int(effective, 16) >> CAP_IPC_LOCK & 1)


def obstacle(pools: int = POOL_LIMIT) -> str:
    """Says why pools of `pools` bytes cannot be used here; empty if they can."""
    if not os.access(SHM, os.W_OK | os.X_OK):
        return f"{SHM} is not writable"
    import resource  # Windows, where clients run, has none, and no /dev/shm

    needed = pools + METADATA
    longest, _ = resource.getrlimit(resource.RLIMIT_FSIZE)  # limits segments of shared memory, too, as they are files
    if longest != resource.RLIM_INFINITY and longest < needed:
        return f"files may have {longest >> 10} KiB, {needed >> 10} KiB are needed (raise it with ulimit -f)"
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and limit < needed and not may_lock_anything():
        return f"the locked-memory limit is {limit >> 10} KiB, {needed >> 10} KiB are needed (raise it with ulimit -l)"
    return ""


def free_bytes() -> int:
    """Returns the free bytes of /dev/shm; a container often has 64 MiB in all."""
    try:
        fs = os.statvfs(SHM)
    except OSError:
        return 0
    return fs.f_bavail * fs.f_frsize
