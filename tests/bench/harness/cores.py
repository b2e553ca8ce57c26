# SPDX-License-Identifier: MIT
"""Who runs on which core: the loop on one, a worker on another, everything else beside the worker or on the rest."""

import os
from dataclasses import dataclass
from pathlib import Path


def _siblings(core: int) -> set[int]:
    """Hardware threads of the same core, itself among them."""
    try:
        text = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list").read_text().strip()
    except OSError:
        return {core}
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


@dataclass(frozen=True)
class Cores:
    """Sets of CPUs as os.sched_setaffinity takes them; all the same where there is one alone."""

    loop: frozenset[int]
    worker: frozenset[int]
    service: frozenset[int]

    @classmethod
    def of_this_process(cls) -> "Cores":
        """Out of those that this process may use (taskset gives it others)."""
        allowed = sorted(os.sched_getaffinity(0))
        loop = allowed[0]
        others = [core for core in allowed if core not in _siblings(loop)] or allowed[1:] or allowed
        rest = [core for core in others[1:] if core not in _siblings(others[0])]
        return cls(frozenset({loop}), frozenset({others[0]}), frozenset(rest or {others[0]}))

    def __str__(self) -> str:
        if self.loop == self.worker:
            return "all on one core"
        service = "beside it" if self.service == self.worker else "on others"
        return f"loop on core {min(self.loop)}, worker on core {min(self.worker)}, service thread and network {service}"
