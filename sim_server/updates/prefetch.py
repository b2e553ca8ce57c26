# SPDX-License-Identifier: MIT
"""How many matrices are copied ahead, where workers factorize many of them within one step.

The loop copies a matrix as it assembles it, once a step. If only as many were requested as there are idle workers, each
of them would get one job a step: with a thousand small bodies, whose step takes a second, it would rest for most of it.
"""

import numpy as np

from sim_server.arrays import Float64
from sim_server.updates.stats import RunningMean

MAX_DEPTH = 256  # matrices held at once
TRANSFER = 1e-3  # s of a job beside the factorization, about


class PrefetchDepth:
    """Number of matrices that workers can factorize within one step: 0 where a factorization takes longer than that."""

    def __init__(self) -> None:
        self.depth = 0
        self._period = RunningMean()  # s from step to step
        self._last: tuple[int, float] | None = None

    def on_step(self, step: int, now: float) -> bool:
        """Takes note of the step at the time `now` [s]; True if it is another one than the last time."""
        if self._last is None or step <= self._last[0]:
            self._last = self._last or (step, now)
            return False
        self._period.add((now - self._last[1]) / (step - self._last[0]))
        self._last = step, now
        return True

    def update(self, seconds: Float64, workers: int) -> None:
        """Computes the depth. seconds: of a factorization of each body, NaN: not known yet."""
        known = seconds[~np.isnan(seconds)]
        if len(known) and self._period.value is not None:
            service = float(known.mean()) + TRANSFER
            self.depth = min(int(workers * self._period.value / service), MAX_DEPTH)
        else:
            self.depth = 0
