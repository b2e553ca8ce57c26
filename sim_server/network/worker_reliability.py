# SPDX-License-Identifier: MIT
"""What became of each worker's jobs: who has ever answered, and whose factors of an object came to nothing.

No network and no clock of its own.
"""

from collections.abc import Collection

GAP = 10.0  # s: a worker that has not answered its first job within it is one that takes jobs and keeps them, ...
DOUBLINGS = 5  # ... and each such one doubles the time until the next newcomer is tried
HOLD = 0.1  # s without jobs of an object after the second in a row that came to nothing, doubled with each further one
MOST = 9  # doublings of that


class WorkerReliability:
    """By worker. A job that came to nothing: no factor, or one that was refused or no use."""

    def __init__(self) -> None:
        self._answered: set[str] = set()
        self._tried: dict[str, float] = {}  # when those that never answered got their first job
        self._failed: dict[tuple[str, str], tuple[int, float]] = {}  # by worker and object: in a row, when last

    def sent(self, worker: str, now: float) -> None:
        """It got a job."""
        if worker not in self._answered:
            self._tried.setdefault(worker, now)

    def answered(self, worker: str) -> None:
        """It answered a job, whatever the answer was."""
        self._answered.add(worker)
        self._tried.pop(worker, None)

    def failed(self, worker: str, object: str, now: float) -> None:
        """One of its jobs came to nothing."""
        count, _ = self._failed.get((worker, object), (0, now))
        self._failed[worker, object] = count + 1, now

    def helped(self, worker: str, object: str) -> None:
        """A solve was made with a factor of it."""
        self._failed.pop((worker, object), None)

    def forget_worker(self, worker: str) -> None:
        """It left; another process of that name knows nothing of it."""
        self._answered.discard(worker)
        self._tried.pop(worker, None)
        for key in [key for key in self._failed if key[0] == worker]:
            del self._failed[key]

    def forget_object(self, object: str) -> None:
        """It has a new epoch."""
        for key in [key for key in self._failed if key[1] == object]:
            del self._failed[key]

    def may_be_asked(self, worker: str, fit: Collection[str], now: float) -> bool:
        """Whether it gets a job at all: always if it has answered before, or if nobody of those who are fit has.

        Else newcomers are tried: at the same time no more than have answered, each with one job until it answers.
        """
        known = sum(name in self._answered for name in fit)
        if worker in self._answered or not known:
            return True
        gap = GAP * 2 ** min(len(self._tried), DOUBLINGS)
        return worker not in self._tried and sum(now - begun < gap for begun in self._tried.values()) < known

    def held(self, worker: str, object: str, now: float) -> bool:
        """Whether it gets no job of the object for now, since those before came to nothing."""
        count, last = self._failed.get((worker, object), (0, 0.0))
        return count > 0 and now - last < HOLD * 2 ** min(count, MOST)

    def failures(self, workers: Collection[str], object: str) -> int:
        """In a row, of the one among the workers that has fewest."""
        return min((self._failed.get((name, object), (0, 0.0))[0] for name in workers), default=0)

    @property
    def failing(self) -> set[str]:
        """Objects of which jobs came to nothing."""
        return {object for _, object in self._failed}
