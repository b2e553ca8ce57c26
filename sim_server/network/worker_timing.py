# SPDX-License-Identifier: MIT
"""How long workers take, from matrix to factor: who is fast, and who is worth waiting for. No clock of its own."""

from collections.abc import Iterable

WEIGHT = 0.3  # of the newest measurement
FIRST = 2.0  # times as long: the first job of an object at a worker, analysis and all
SLOWEST = 100.0  # bound of what is believed of a worker
HANGS = 3.0  # times the expected time after which a busy worker is not waited for


class WorkerTiming:
    """Times [s] by worker and object, and of each worker how many times slower it is than the best."""

    def __init__(self) -> None:
        self._seconds: dict[str, dict[str, float]] = {}  # of an object, by worker
        self._slowness: dict[str, float] = {}

    def note(self, worker: str, object: str, seconds: float, own: float | None = None) -> None:
        """A job was answered after so many seconds; own: what the worker counts for the factorization alone.

        That is what the first job of an object at a worker counts, since it took an analysis too.
        """
        of_object = self._seconds.setdefault(object, {})
        if own is not None and worker not in of_object:
            seconds = min(seconds, own)
        last = of_object.get(worker)
        of_object[worker] = seconds if last is None else last + WEIGHT * (seconds - last)
        best = min(of_object.values())
        if len(of_object) > 1 and best > 0:  # a worker alone with its objects is compared with nobody
            ratio = min(SLOWEST, of_object[worker] / best)
            last = self._slowness.get(worker, ratio)
            self._slowness[worker] = last + WEIGHT * (ratio - last)

    def forget_worker(self, worker: str) -> None:
        """It left; another process of that name may be on another machine."""
        self._slowness.pop(worker, None)
        for of_object in self._seconds.values():
            of_object.pop(worker, None)

    def forget_object(self, object: str) -> None:
        """It has a new epoch, and perhaps another size."""
        self._seconds.pop(object, None)

    def slowness(self, worker: str) -> float:
        """1 for the fastest and for those not compared yet."""
        return self._slowness.get(worker, 1.0)

    def expected(self, worker: str, object: str) -> float:
        """Time [s] of the next job of the object at the worker; 0 for a worker that was never compared, so that it is
        tried, and while nothing is known of the object."""
        of_object = self._seconds.get(object, {})
        if worker in of_object:
            return of_object[worker]
        return FIRST * min(of_object.values(), default=0.0) * self._slowness.get(worker, 0.0)

    def ahead(self, idle: Iterable[tuple[str, float]], busy: Iterable[tuple[str, str, float]]) -> int:
        """How many busy workers would be done with one more job before the fastest idle one: so many of the most
        urgent objects are left for them. None once that one was idle for as long as a job takes it.

        idle: (worker, seconds since when), busy: (worker, object, seconds since it was sent).
        """
        known = [min(times.values()) for times in self._seconds.values() if times]
        own, since = min(((self.slowness(worker), -since) for worker, since in idle), default=(0.0, 0.0))
        if not own or not known:
            return 0
        usual = sum(known) / len(known)
        if -since > own * usual:
            return 0
        return sum(
            self._left(worker, object, elapsed) + self.slowness(worker) * usual < own * usual
            for worker, object, elapsed in busy
        )

    def _left(self, worker: str, object: str, elapsed: float) -> float:
        expected = self.expected(worker, object)
        if elapsed > HANGS * expected:
            return float("inf")
        return max(expected - elapsed, 0.25 * expected)
