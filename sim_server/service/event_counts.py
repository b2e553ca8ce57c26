# SPDX-License-Identifier: MIT
"""Counts the steps in which something went wrong, by object and what it was (docs/failures.md)."""

from collections import Counter, defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

STATUSES = {value.number: value.name.lower() for value in pb.SolveStatus.DESCRIPTOR.values}
COLUMNS = ("fallbacks", "halvings")  # of the step record: above 0 in a step that counts


class EventCounts:
    """Steps by body and event: each status but converged, and COLUMNS."""

    def __init__(self) -> None:
        self._counts: defaultdict[int, Counter[str]] = defaultdict(Counter)

    def add(self, records: NDArray[Any]) -> None:
        """Counts step records (structs.RECORD)."""
        bad = records[records["status"] != pb.CONVERGED]
        for body, status in zip(bad["body"].tolist(), bad["status"].tolist(), strict=True):
            self._counts[body][STATUSES[status]] += 1
        for column in COLUMNS:
            for body in records["body"][np.flatnonzero(records[column] > 0)].tolist():
                self._counts[body][column] += 1

    def of(self, body: int) -> list[pb.EventCount]:
        """Returns the counts of a body, the largest first."""
        counts = self._counts.get(body, Counter()).most_common()
        return [pb.EventCount(event=event, steps=steps) for event, steps in counts]

    def clear(self, body: int) -> None:
        """Begins the counts of a body anew."""
        self._counts.pop(body, None)
