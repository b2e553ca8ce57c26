# SPDX-License-Identifier: MIT
"""What went wrong in the steps of an object, from its scalars (docs/failures.md)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from clients.log.scalars import Columns

COUNTS = {
    "fallbacks": "a factor left for block Jacobi",
    "halvings": "ran away, made again by short steps",
    "clipped": "nodes held back at an obstacle",
}
"""Columns that are above 0 in a step in which this happened."""


class Event(NamedTuple):
    """From this step on something goes wrong, or goes wrong no more. time [s]: of simulation."""

    step: int
    time: float
    text: str
    wrong: bool


class Events:
    """Finds the steps at which what goes wrong changes, in one batch of steps after another."""

    def __init__(self) -> None:
        self._now: tuple[str, ...] = ()

    def changes(self, scalars: Columns) -> Iterator[Event]:
        """Yields the events of the next steps, ascending."""
        counts = [(text, scalars[column].tolist()) for column, text in COUNTS.items()]
        times = scalars["time"].tolist()
        for k, (step, status) in enumerate(zip(scalars["step"].tolist(), scalars["status"].tolist(), strict=True)):
            found = (*([status] if status != "converged" else ()), *(text for text, n in counts if n[k]))
            if found != self._now:
                self._now = found
                yield Event(step, times[k], ", ".join(found) or "converged again", bool(found))
