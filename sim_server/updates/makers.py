# SPDX-License-Identifier: MIT
"""Who made the last factors of each body, by columns: noted of all factors of a message in a few operations."""

from collections.abc import Sequence

import numpy as np

from sim_server.arrays import Int64

KEPT = 32  # factors of a body whose worker is remembered
NO_STEP = np.iinfo(np.int64).min


class Makers:
    """Steps of the last KEPT factors of each body, and who made them."""

    def __init__(self, bodies: int):
        self._steps = np.full((bodies, KEPT), NO_STEP, np.int64)
        self._makers = np.zeros((bodies, KEPT), np.int32)
        self._noted = np.zeros(bodies, np.int64)  # so far
        self._names: list[str] = []
        self._numbers: dict[str, int] = {}

    def note(self, bodies: Int64, steps: Int64, workers: Sequence[str]) -> None:
        """Takes note of factors of different bodies."""
        for name in dict.fromkeys(workers):
            if name not in self._numbers:
                self._numbers[name] = len(self._names)
                self._names.append(name)
        places = self._noted[bodies] % KEPT
        self._steps[bodies, places], self._makers[bodies, places] = steps, [self._numbers[name] for name in workers]
        self._noted[bodies] += 1

    def of(self, body: int) -> dict[int, str]:
        """Returns the workers of the last factors of a body, by step, oldest first."""
        noted = int(self._noted[body])
        places = [k % KEPT for k in range(max(0, noted - KEPT), noted)]
        return {int(self._steps[body, k]): self._names[self._makers[body, k]] for k in places}

    def worker(self, body: int, step: int) -> str:
        """Returns who made the factor of a step; empty if that is not remembered."""
        found = np.flatnonzero(self._steps[body] == step)
        return self._names[self._makers[body, found[-1]]] if len(found) else ""
