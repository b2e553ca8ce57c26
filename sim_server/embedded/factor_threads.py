# SPDX-License-Identifier: MIT
"""Threads of this process that make factors while steps run, as workers of a server do in processes of their own.

Steps and factorizations are native code, which lets go of Python's lock, so that neither waits for the other.
"""

import logging
import queue
import threading
from dataclasses import replace
from typing import TypeVar

from protocol.factor import Factor
from sim_server.updates.factor_source import FactorSource, Inline, Job
from sim_server.updates.patterns import Patterns

log = logging.getLogger(__name__)
T = TypeVar("T")


class NoFactors(FactorSource):
    """A source without a worker, as of a server to which none has come."""

    def ready(self) -> int:
        """Returns 0."""
        return 0

    def submit(self, job: Job) -> bool:
        """Refuses the job."""
        return False

    def poll(self) -> list[Factor]:
        """Returns no factor."""
        return []

    def failures(self) -> list[tuple[str, str]]:
        """Returns no failure."""
        return []

    def worker_count(self) -> int:
        """Returns 0."""
        return 0


class FactorThreads(FactorSource):
    """Factorizes in `workers` threads, each of which has analyses of its own. To be closed."""

    def __init__(self, patterns: Patterns, workers: int):
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[Factor] = queue.SimpleQueue()
        self._failed: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._lock, self._busy = threading.Lock(), 0
        given = [(Inline(patterns), f"thread {k + 1}") for k in range(workers)]
        self._threads = [threading.Thread(target=self._work, args=each, name=each[1], daemon=True) for each in given]
        for thread in self._threads:
            thread.start()

    def ready(self) -> int:
        """Returns the number of idle threads."""
        return len(self._threads) - self._busy

    def submit(self, job: Job) -> bool:
        """Copies the matrix for a thread; False if all are busy."""
        if self.ready() <= 0:
            return False
        with self._lock:
            self._busy += 1
        self._jobs.put(replace(job, values=job.values.copy()))
        return True

    def poll(self) -> list[Factor]:
        """Returns the factors made since the last call."""
        return _taken(self._done)

    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of the jobs that ended without a factor since the last call."""
        return _taken(self._failed)

    def worker_count(self) -> int:
        """Returns the number of threads."""
        return len(self._threads)

    def close(self) -> None:
        """Ends the threads, which finish what they are at. More than once is allowed."""
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join()
        self._threads = []

    def _work(self, inline: Inline, name: str) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                inline.submit(job)
                made, failed = inline.poll(), inline.failures()
            except Exception as error:  # no compiler, no memory: the steps go on
                log.debug("object %r: no factor", job.object, exc_info=True)
                made, failed = [], [(job.object, f"{type(error).__name__}: {error}")]
            for factor in made:
                self._done.put(replace(factor, worker=name))
            for failure in failed:
                self._failed.put(failure)
            with self._lock:
                self._busy -= 1


def _taken(waiting: "queue.SimpleQueue[T]") -> list[T]:
    return [waiting.get() for _ in range(waiting.qsize())]
