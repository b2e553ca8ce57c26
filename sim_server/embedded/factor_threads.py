# SPDX-License-Identifier: MIT
"""Threads of this process that make factors while steps run, as workers of a server do in processes of their own.

Steps and factorizations are native code, which lets go of Python's lock, so that neither waits for the other.
"""

import logging
import os
import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
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


class _Forks:
    """Has forks of this process wait for factorizations under way, which would never end: OpenBLAS ends its threads
    before a fork, and who waits for what they were at goes on to wait."""

    def __init__(self) -> None:
        self._changed, self._under_way, self._forking = threading.Condition(), 0, False

    @contextmanager
    def kept_off(self) -> Iterator[None]:
        """A context in which no fork begins."""
        with self._changed:
            self._changed.wait_for(lambda: not self._forking)
            self._under_way += 1
        try:
            yield
        finally:
            with self._changed:
                self._under_way -= 1
                self._changed.notify_all()

    def before(self) -> None:
        self._changed.acquire()
        self._forking = True
        self._changed.wait_for(lambda: not self._under_way)

    def after_in_parent(self) -> None:
        self._forking = False
        self._changed.notify_all()
        self._changed.release()

    def after_in_child(self) -> None:
        self.__init__()  # type: ignore[misc]  # nobody else is there


_forks = _Forks()
os.register_at_fork(before=_forks.before, after_in_parent=_forks.after_in_parent, after_in_child=_forks.after_in_child)


class FactorThreads(FactorSource):
    """Factorizes in `workers` threads, each of which has analyses of its own. To be closed.

    In a process that was forked, which has no threads but one, they begin anew with the jobs that they had.
    """

    def __init__(self, patterns: Patterns, workers: int):
        self._patterns, self._workers = patterns, workers
        self._given: dict[str, Job] = {}  # by object, those whose end nobody has been told of
        self._begin()

    def _begin(self) -> None:
        """Starts the threads. Nothing that the threads of another process may have held is used again."""
        self._process = os.getpid()
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[Factor] = queue.SimpleQueue()
        self._failed: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._lock, self._busy = threading.Lock(), len(self._given)
        for job in self._given.values():
            self._jobs.put(job)
        given = [(Inline(self._patterns), f"thread {k + 1}") for k in range(self._workers)]
        self._threads = [threading.Thread(target=self._work, args=each, name=each[1], daemon=True) for each in given]
        for thread in self._threads:
            thread.start()

    def _go_on(self) -> None:
        """Begins anew in a process that was forked since."""
        if self._process != os.getpid():
            self._begin()

    def ready(self) -> int:
        """Returns the number of idle threads."""
        self._go_on()
        return len(self._threads) - self._busy

    def submit(self, job: Job) -> bool:
        """Copies the matrix for a thread; False if all are busy."""
        if self.ready() <= 0:
            return False
        with self._lock:
            self._busy += 1
        self._given[job.object] = job = replace(job, values=job.values.copy())
        self._jobs.put(job)
        return True

    def poll(self) -> list[Factor]:
        """Returns the factors made since the last call."""
        self._go_on()
        made = _taken(self._done)
        for factor in made:
            self._end(factor.object, factor.step)
        return made

    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of the jobs that ended without a factor since the last call."""
        self._go_on()
        failed = _taken(self._failed)
        for name, _ in failed:
            self._end(name)
        return failed

    def _end(self, name: str, step: int | None = None) -> None:
        """Forgets a job, unless it is of another step."""
        if (job := self._given.get(name)) is not None and step in (None, job.step):
            del self._given[name]

    def worker_count(self) -> int:
        """Returns the number of threads."""
        return len(self._threads)

    def close(self) -> None:
        """Ends the threads, which finish what they are at. More than once is allowed."""
        if self._process == os.getpid():  # another process has its own
            for _ in self._threads:
                self._jobs.put(None)
            for thread in self._threads:
                thread.join()
        self._threads = []

    def _work(self, inline: Inline, name: str) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                with _forks.kept_off():
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
