# SPDX-License-Identifier: MIT
"""How many matrices are copied ahead, where workers factorize many of them before a copy is there.

The loop copies a matrix as it assembles it, once a step, and a GPU brings it to the host some steps later. If only as
many were requested as there are idle workers, these would rest meanwhile: with a thousand small bodies, for most of the
time.
"""

from sim_server.updates.stats import RunningMean

MAX_DEPTH = 256  # matrices held at once
SHARE = 8  # of the bodies one in so many at most: more come sooner, and grow older on their way than that is worth
MAX_WAIT = 2  # steps that a copied matrix may wait for a worker, and those that a copy takes beyond one
MORE = 1.5  # copies that are begun over those that a worker could make meanwhile by what it reports
TRANSFER = 1e-3  # s of a job beside the factorization, about


class PrefetchDepth:
    """Number of matrices that workers can factorize within one step, or until a copy is there if that takes longer: 0
    where a factorization takes longer than that.

    patience: steps that a copy may wait for a worker
    queued: several jobs wait at each worker
    """

    def __init__(self) -> None:
        self.depth, self.patience, self.queued = 0, MAX_WAIT, False
        self._period = RunningMean()  # s from step to step
        self._copy = RunningMean()  # s from the request of a copy until it can be sent
        self._last: tuple[int, float] | None = None

    def on_step(self, step: int, now: float) -> bool:
        """Takes note of the step at the time `now` [s]; True if it is another one than the last time."""
        if self._last is None or step <= self._last[0]:
            self._last = self._last or (step, now)
            return False
        self._period.add((now - self._last[1]) / (step - self._last[0]))
        self._last = step, now
        return True

    def on_copy(self, seconds: float) -> None:
        """Takes note of copies that could be sent so many seconds after their requests, in the mean."""
        self._copy.add(seconds)

    def update(self, seconds: float | None, bodies: int, workers: int, queued: bool = False) -> None:
        """Computes the depth.

        seconds: of a factorization, in the mean of so many bodies; None: not known yet
        queued: several jobs wait at each worker, for which their transfer then takes no time
        """
        self.depth, self.queued = 0, queued
        period = self._period.value
        if seconds is not None and period is not None:
            ahead = max(period, self._copy.value or 0.0)
            depth = workers * period / (seconds + TRANSFER)
            if queued:
                depth = max(depth, min(MORE * workers * ahead / seconds, bodies / SHARE))
            self.depth = min(int(depth), MAX_DEPTH)
            self.patience = MAX_WAIT + int(ahead / period) - 1 if period > 0 else MAX_WAIT
