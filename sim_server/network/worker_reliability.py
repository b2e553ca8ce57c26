# SPDX-License-Identifier: MIT
"""Which workers answer, and which of them make useful factors of an object. Without network or clock.

A job fails if it brings no factor, or one that is rejected or that solves abandon.
"""

from collections.abc import Collection

FIRST_ANSWER = 10.0  # s in which a new worker should answer its first job before the next new one is tried
MAX_DOUBLINGS = 5  # of that time; each new worker without an answer doubles it
SUSPENSION = 0.1  # s, doubled with each failure in a row, in which a worker gets no jobs of the object
MAX_SUSPENSION_DOUBLINGS = 9


class WorkerReliability:
    """Answers and failures by worker."""

    def __init__(self) -> None:
        self._answered: set[str] = set()
        self._tried: dict[str, float] = {}  # time of the first job of workers that never answered
        self._failed: dict[tuple[str, str], tuple[int, float]] = {}  # (worker, object): failures in a row, last time

    def on_sent(self, worker: str, now: float) -> None:
        """Notes that a worker got a job."""
        if worker not in self._answered:
            self._tried.setdefault(worker, now)

    def on_answer(self, worker: str) -> None:
        """Notes that a worker answered a job, with a factor or without."""
        self._answered.add(worker)
        self._tried.pop(worker, None)

    def on_failure(self, worker: str, object: str, now: float) -> None:
        """Notes that a job failed."""
        count, _ = self._failed.get((worker, object), (0, now))
        self._failed[worker, object] = count + 1, now

    def on_success(self, worker: str, object: str) -> None:
        """Notes that a solve was made with a factor of the worker."""
        self._failed.pop((worker, object), None)

    def forget_worker(self, worker: str) -> None:
        """Drops a worker that left; another process of that name starts anew."""
        self._answered.discard(worker)
        self._tried.pop(worker, None)
        for key in [key for key in self._failed if key[0] == worker]:
            del self._failed[key]

    def forget_object(self, object: str) -> None:
        """Drops an object that has a new epoch."""
        for key in [key for key in self._failed if key[1] == object]:
            del self._failed[key]

    def may_get_job(self, worker: str, available: Collection[str], now: float) -> bool:
        """True if the worker has answered before, or if no available worker has.

        Else new workers are tried: at the same time no more than have answered, each with one job until it answers.
        """
        answering = sum(name in self._answered for name in available)
        if worker in self._answered or not answering:
            return True
        period = FIRST_ANSWER * 2 ** min(len(self._tried), MAX_DOUBLINGS)
        return worker not in self._tried and sum(now - begun < period for begun in self._tried.values()) < answering

    def is_suspended(self, worker: str, object: str, now: float) -> bool:
        """True while the worker gets no jobs of the object, since the ones before failed."""
        count, last = self._failed.get((worker, object), (0, 0.0))
        return count > 0 and now - last < SUSPENSION * 2 ** min(count, MAX_SUSPENSION_DOUBLINGS)

    def consecutive_failures(self, workers: Collection[str], object: str) -> int:
        """Failures in a row of the worker that has fewest."""
        return min((self._failed.get((name, object), (0, 0.0))[0] for name in workers), default=0)

    @property
    def failing_objects(self) -> set[str]:
        """Objects with failures at any worker."""
        return {object for _, object in self._failed}
