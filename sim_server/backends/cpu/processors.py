# SPDX-License-Identifier: MIT
"""How many threads of this process can run at the same time."""

import logging
import math
import os
from pathlib import Path

log = logging.getLogger(__name__)

CGROUPS, OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def usable_processors() -> int:
    """Returns how many processors this process may keep busy, by its affinity and the limits of control groups."""
    return max(1, math.ceil(min(len(os.sched_getaffinity(0)), quota())))


def usable_threads(wanted: int) -> int:
    """Returns `wanted`, or as many as there are processors for this process where those are fewer; says so then."""
    allowed = usable_processors()
    if wanted > allowed:
        log.warning(
            "solver.threads = %d: this process may use %d processor%s, so the step has %d thread%s",
            wanted, allowed, "s" * (allowed > 1), allowed, "s" * (allowed > 1),
        )  # fmt: skip
    return min(wanted, allowed)


def quota() -> float:
    """Returns the processors' worth of time that control groups allow this process; infinite without a limit.

    Versions 1 and 2 are read.
    """
    try:
        groups = [line.split(":", 2) for line in OWN_CGROUPS.read_text().splitlines()]
    except OSError:
        return math.inf
    found = math.inf
    for _, controllers, path in (group for group in groups if len(group) == 3):
        if not controllers:
            root, files = CGROUPS, ["cpu.max"]
        elif "cpu" in controllers.split(","):
            root, files = CGROUPS / "cpu", ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
        else:
            continue
        own = root / path.lstrip("/")
        for folder in (own, *own.parents):  # a limit of any of them holds
            if folder == root.parent:
                break
            found = min(found, _limit([folder / file for file in files]))
    return found


def _limit(files: list[Path]) -> float:
    """Time over period, of one file with both or of two; infinite where nothing is limited or known."""
    try:
        time, period = (int(word) for file in files for word in file.read_text().split())
    except (OSError, ValueError):  # "max": no limit
        return math.inf
    return time / period if time > 0 and period > 0 else math.inf
