# SPDX-License-Identifier: MIT
"""Step records that wait to be sent to subscribers."""

from collections import deque
from typing import Any, NamedTuple

from numpy.typing import NDArray

from sim_server.recording.object_steps import Reactions, Readings


class Batch(NamedTuple):
    """Records with what objects exerted in their steps, and what effects told of them."""

    records: NDArray[Any]
    reactions: Reactions
    readings: Readings | None


class UnsentSteps:
    """Keeps the newest records, as the loop told them: they are made messages only when they are sent."""

    def __init__(self, most: int):
        self._most, self._batches = most, deque[Batch]()
        self._count = self._left_out = 0

    def add(self, records: NDArray[Any], reactions: Reactions, readings: Readings | None) -> None:
        """Adds records, and leaves out the oldest above the largest number."""
        self._batches.append(Batch(records, reactions, readings))
        self._count += len(records)
        while (excess := self._count - self._most) > 0:
            oldest = self._batches.popleft()
            gone = min(excess, len(oldest.records))
            if gone < len(oldest.records):
                told = None if oldest.readings is None else oldest.readings[gone:]
                self._batches.appendleft(Batch(oldest.records[gone:], oldest.reactions[gone:], told))
            self._count -= gone
            self._left_out += gone

    def take(self) -> tuple[list[Batch], int]:
        """Removes and returns all, and the number of those that were left out since the last call."""
        taken = list(self._batches), self._left_out
        self._batches.clear()
        self._count = self._left_out = 0
        return taken
