# SPDX-License-Identifier: MIT
"""How many matrices are copied ahead, where workers factorize many of them within one step.

The loop copies a matrix as it assembles it, once a step. Were only as many asked for as there are idle workers, each of
them would get one job a step: with a thousand small bodies, whose step takes a second, it would rest for most of it.
"""

from collections.abc import Iterable

from sim_server.updates.stats import Mean

MOST = 256  # matrices held at once
TRANSFER = 1e-3  # s of a job beside the factorization, about


class Stock:
    """size: matrices that workers can factorize within one step; 0 where a factorization takes longer than a step."""

    def __init__(self) -> None:
        self.size = 0
        self._pace = Mean()  # s from step to step
        self._last: tuple[int, float] | None = None

    def paced(self, step: int, now: float) -> bool:
        """Told of the step at `now` [s]; True if it is another one than the last time."""
        if self._last is None or step <= self._last[0]:
            self._last = self._last or (step, now)
            return False
        self._pace.add((now - self._last[1]) / (step - self._last[0]))
        self._last = step, now
        return True

    def reckon(self, seconds: Iterable[float | None], workers: int) -> None:
        """seconds: of a factorization of each body, None: not yet known."""
        known = [s for s in seconds if s is not None]
        if known and self._pace.value is not None:
            service = sum(known) / len(known) + TRANSFER
            self.size = min(int(workers * self._pace.value / service), MOST)
        else:
            self.size = 0
