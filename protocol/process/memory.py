# SPDX-License-Identifier: MIT
"""Memory of this process: how much it may still take, by what the kernel says of the machine and of its control groups,
and what stays in it as long as it runs."""

import gc
from collections.abc import Iterator
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
YOUNG = 20_000  # objects made since the last garbage collection and still there, from which on there is another one


def available_memory() -> int | None:
    """Returns the bytes that can be had without swapping or being killed; None: not known, as on other systems."""
    known = [*_of_machine(), *_of_groups()]
    return max(0, min(known)) if known else None


def keep_long_lived() -> None:
    """Has the garbage collector never look again at the objects that are there now. A collection of all generations
    would go through them, modules and what they hold, and keep Python's lock for some 50 ms meanwhile.

    It looks at those to come more seldom than by itself: where jobs of hundreds of objects come and go it would do so a
    hundred times a second, and find next to nothing. What is in no cycle is freed at once all the same."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(max(YOUNG, gc.get_threshold()[0]), *gc.get_threshold()[1:])


def _of_machine() -> Iterator[int]:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return
    yield from (int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:"))


def _of_groups() -> Iterator[int]:
    """Yields what each control group (version 2) of the process has left; its cache of files can be dropped."""
    try:
        own = Path("/proc/self/cgroup").read_text().partition("0::")[2].strip()
    except OSError:
        return
    group = GROUPS / own.lstrip("/")
    for folder in (group, *group.parents):
        try:
            limit = int((folder / "memory.max").read_text())  # "max" where there is none
            used = int((folder / "memory.current").read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            yield limit - used + int(stat.get("inactive_file", 0))
        except (OSError, ValueError):
            pass
        if folder == GROUPS:
            return
