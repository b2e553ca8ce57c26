# SPDX-License-Identifier: MIT
"""Measured times of workers, from matrix to factor: which worker is fast, and which is worth waiting for. No clock."""

from collections.abc import Iterable, Sequence

WEIGHT = 0.3  # of the newest measurement in a running mean
FIRST_JOB = 2.0  # the first job of an object at a worker is expected to take this multiple of the usual time
MAX_SLOWNESS = 100.0
HANGING = 3.0  # a busy worker is not waited for after this multiple of the expected time


class WorkerTiming:
    """Time [s] of a job by object and worker, and the slowness of each worker: its time over that of the fastest."""

    def __init__(self) -> None:
        self._seconds: dict[str, dict[str, float]] = {}  # by object, then by worker
        self._slowness: dict[str, float] = {}
        self._factorizations: dict[str, float] = {}  # s, running mean of what each worker reports

    def record(self, worker: str, object: str, seconds: float, factorization: float | None = None) -> None:
        """Adds the measured time of an answered job.

        factorization: time [s] that the worker reports for the factorization alone. It counts for the first job of
            an object at a worker, which took an analysis too.
        """
        if factorization is not None:
            mean = self._factorizations.get(worker)
            step = 0.0 if mean is None else WEIGHT * (factorization - mean)
            self._factorizations[worker] = factorization if mean is None else mean + step
        of_object = self._seconds.setdefault(object, {})
        if factorization is not None and worker not in of_object:
            seconds = min(seconds, factorization)
        last = of_object.get(worker)
        of_object[worker] = seconds if last is None else last + WEIGHT * (seconds - last)
        best = min(of_object.values())
        if len(of_object) > 1 and best > 0:  # a single worker of an object cannot be compared
            ratio = min(MAX_SLOWNESS, of_object[worker] / best)
            last = self._slowness.get(worker, ratio)
            self._slowness[worker] = last + WEIGHT * (ratio - last)

    def record_all(self, worker: str, objects: Sequence[str], seconds: float, factorizations: Sequence[float]) -> None:
        """Adds the answers to jobs of a message, each as `record` does. seconds: of each job"""
        mean, sum_up = self._factorizations.get(worker), self._seconds.setdefault
        for object, factorization in zip(objects, factorizations, strict=True):
            mean = factorization if mean is None else mean + WEIGHT * (factorization - mean)
            of_object = sum_up(object, {})
            last = of_object.get(worker)
            if last is None or len(of_object) > 1:
                self.record(worker, object, seconds if last is not None else min(seconds, factorization))
            else:
                of_object[worker] = last + WEIGHT * (seconds - last)
        if mean is not None:
            self._factorizations[worker] = mean

    def forget_worker(self, worker: str) -> None:
        """Drops a worker that left; another process of that name may be on another machine."""
        self._slowness.pop(worker, None)
        self._factorizations.pop(worker, None)
        for of_object in self._seconds.values():
            of_object.pop(worker, None)

    def forget_object(self, object: str) -> None:
        """Drops an object that has a new epoch, and perhaps another size."""
        self._seconds.pop(object, None)

    def mean_factorization(self, worker: str) -> float | None:
        """Running mean of the times [s] that a worker reports for factorizations; None: it has reported none."""
        return self._factorizations.get(worker)

    def slowness(self, worker: str) -> float:
        """Time of a worker over that of the fastest; 1 for workers that were not compared yet."""
        return self._slowness.get(worker, 1.0)

    def expected(self, worker: str, object: str) -> float:
        """Expected time [s] of the next job of the object at the worker.

        0 while nothing is known of the object, and for a worker that was never compared, so that it is tried.
        """
        of_object = self._seconds.get(object, {})
        if worker in of_object:
            return of_object[worker]
        return FIRST_JOB * min(of_object.values(), default=0.0) * self._slowness.get(worker, 0.0)

    def faster_busy_workers(self, idle: Iterable[tuple[str, float]], busy: Iterable[tuple[str, str, float]]) -> int:
        """Number of busy workers that would finish one more job before the fastest idle one could.

        0 once the fastest idle worker was idle for as long as it takes for a job.

        idle: (worker, time [s] since when it is idle)
        busy: (worker, object, time [s] since its job was sent)
        """
        busy = list(busy)
        if not busy:
            return 0
        own, since = min(((self.slowness(worker), -since) for worker, since in idle), default=(0.0, 0.0))
        known = [min(times.values()) for times in self._seconds.values() if times] if own else []
        if not known:
            return 0
        usual = sum(known) / len(known)
        if -since > own * usual:
            return 0
        return sum(
            self._remaining(worker, object, elapsed) + self.slowness(worker) * usual < own * usual
            for worker, object, elapsed in busy
        )

    def _remaining(self, worker: str, object: str, elapsed: float) -> float:
        expected = self.expected(worker, object)
        if elapsed > HANGING * expected:
            return float("inf")
        return max(expected - elapsed, 0.25 * expected)
