# SPDX-License-Identifier: MIT
"""The loop of one server: takes the newest matrix of an object, factorizes it and sends the factor."""

import time
from collections.abc import Callable, Sequence

from precond_worker.errors import DeviceUnusable, NameTaken
from precond_worker.jobs.analyses import Analyse, Analyses
from precond_worker.jobs.answers import Answers
from precond_worker.jobs.job import Job, accept
from precond_worker.jobs.one_by_one import OneByOne
from precond_worker.jobs.preparation import Preparation
from precond_worker.jobs.together import JobsTogether, Together
from precond_worker.network.presence import ServerGone, ServersThere
from precond_worker.network.server_connection import ServerConnection
from protocol.refused import Refused

ANSWER_SECONDS = 3e-3  # s for which answers wait for others of their batch


class Worker:
    """Does the jobs of one server: the object that waits longest first, of each the newest matrix; together with it
    those of other objects, where a library factorizes many matrices of one pattern at a time. While a device does, the
    next ones are made ready, and the last ones sent. Before there is a job large objects are prepared."""

    def __init__(
        self, connection: ServerConnection, analyse: Analyse, on_server: Callable[[bool], None] = lambda found: None,
        on_factorization: Callable[[float], None] = lambda seconds: None,
    ):  # fmt: skip
        self._connection, self._counters, self._on_server = connection, connection.counters, on_server
        self._analyses, self._answers = Analyses(connection, analyse), Answers(connection)
        self._one_by_one = OneByOne(connection, self._analyses, self._answers, on_factorization)
        self._together = Together(connection, self._analyses, self._answers, self._one_by_one, on_factorization)
        self.preparation = Preparation(connection, self._analyses)
        self._pending: dict[str, Job] = {}
        self._under_way: JobsTogether | None = None

    def run(self) -> None:
        """Works until an exception such as KeyboardInterrupt."""
        while True:
            self.step(1.0)

    def step(self, timeout: float) -> None:
        """Takes in what was received, waiting up to `timeout` seconds for it, and does one job."""
        self.take_in(timeout)
        self.work()

    @property
    def idle(self) -> bool:
        """True if no job waits, taken in or not."""
        return not self.waiting and self._connection.received.idle

    @property
    def waiting(self) -> int:
        """Number of jobs taken in and not done; 1 while there is something to prepare."""
        jobs = len(self._pending) + (0 if self._under_way is None else len(self._under_way.jobs))
        return jobs or int(self.pause <= 0)

    @property
    def pause(self) -> float:
        """Time [s] until there is something to prepare; inf: there is nothing."""
        return self.preparation.pause

    # ---- what is received ------------------------------------------------------------------------------------

    def take_in(self, timeout: float) -> None:
        """Takes in what was received; without a waiting job, waits up to `timeout` seconds for it."""
        for item in self._connection.received.take(0.0 if self.waiting else min(timeout, self.pause)):
            if isinstance(item, NameTaken):
                raise item
            try:
                if isinstance(item, ServerGone):
                    self._leave_server(item.incarnation)
                elif isinstance(item, ServersThere):
                    self._choose_server(item.incarnations)
                else:
                    connection = self._connection
                    for job in accept(item, connection.server, connection.name, connection.incarnation):
                        self._enqueue(job)
            except Refused as refusal:
                self._counters.refuse(refusal)
        self._done()

    def _enqueue(self, job: Job) -> None:
        waiting = self._pending.get(job.object)
        if waiting is not None:
            self._counters.add("superseded")
            if waiting.number >= job.number:
                return
        self._pending[job.object] = job

    def _leave_server(self, gone: int) -> None:
        if gone == self._connection.incarnation:
            self._forget()
            self._connection.follow(0)
            self._on_server(False)

    def _choose_server(self, there: Sequence[int]) -> None:
        """Keeps the incarnation that is served while it answers, else takes one that answers and has a token."""
        if self._connection.incarnation in there:
            return
        for incarnation in there:
            if self._connection.has_token(incarnation):
                self._forget()
                self._connection.follow(incarnation)
                self._on_server(True)
                if self._connection.shared_memory:  # topologies are large for a network, and jobs may never come
                    self.preparation.begin()
                return

    def _forget(self) -> None:
        self.preparation.clear()
        self._counters.add("superseded", self.waiting)
        self._pending.clear()
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.made.end()  # until then a device writes to memory that is freed with the analysis
        self._analyses.clear()
        self._one_by_one.assemblers.clear()
        self._connection.offered.clear()

    def _done(self) -> None:
        if not self.waiting:
            self._connection.received.done()

    # ---- jobs ------------------------------------------------------------------------------------------------

    def work(self) -> bool:
        """Does one job, or several of one pattern together; returns False if there is none."""
        if not self.waiting:
            return False
        if self.preparation.unprepared and not self._pending and self._under_way is None:
            self.preparation.do_next()
            self._done()
            if not self.preparation.unprepared:
                self._connection.tell()  # the server may wait for that
            return True
        try:
            self._work()
        finally:
            self._answers.send()
        self._done()
        return True

    def finish(self) -> None:
        """Waits for the jobs that are under way, and answers them."""
        under_way, self._under_way = self._under_way, None
        if under_way is None:
            return
        try:
            self._end(under_way)
        finally:
            self._answers.send()
        self._done()

    def _work(self) -> None:
        """Does jobs of one message for a while: their answers leave together."""
        end = time.perf_counter() + ANSWER_SECONDS
        while True:
            jobs: Sequence[Job] = self._next() if self._pending else ()
            done = self._do(jobs)
            jobs = jobs or (done.jobs if done else ())
            following = next(iter(self._pending.values()), None)
            together = following is not None and following.batch is not None and following.batch is jobs[-1].batch
            if not together or time.perf_counter() > end:
                return

    def _do(self, jobs: Sequence[Job]) -> JobsTogether | None:
        """Does jobs, or begins to if a device does them, and ends those before, which it returns. A job that came alone
        is done alone."""
        begun = self._begin(jobs) if len(jobs) > 1 else None
        done, self._under_way = self._under_way, begun
        if done is not None:
            self._end(done)
        if begun is None:
            for job in jobs:
                self._one_by_one.do(job)
        elif not begun.made.beside:
            self._under_way = None
            self._end(begun)
        return done

    def _next(self) -> list[Job]:
        """Takes the job that waits longest, and others that can be factorized together with it."""
        first = self._pending.pop(next(iter(self._pending)))
        known = self._analyses.known(first)
        if known is None or known.blocks != first.blocks:
            return [first]
        self._connection.together = self._analyses.together
        most: int = getattr(known.factorization, "most", 1) if first.is_plain else 1
        jobs = [first]
        for name, job in list(self._pending.items()) if most > 1 else ():
            if len(jobs) >= most:
                break
            if job.dtype != first.dtype or not job.is_plain:
                continue
            other = self._analyses.known(job)
            if other is not None and other.factorization is known.factorization and job.blocks == known.blocks:
                jobs.append(self._pending.pop(name))
        return jobs

    def _begin(self, jobs: Sequence[Job]) -> JobsTogether | None:
        try:
            return self._together.begin(jobs)
        except DeviceUnusable as error:
            self._give_up(jobs, error)
            raise

    def _end(self, together: JobsTogether) -> None:
        """Waits for factors, and answers with them."""
        try:
            made = together.made.end()
        except DeviceUnusable as error:
            self._give_up(together.jobs, error)
            raise
        self._together.answer(together, made)

    def _give_up(self, jobs: Sequence[Job], error: DeviceUnusable) -> None:
        under_way = self._under_way.jobs if self._under_way else ()
        self._together.give_up([*under_way, *jobs], error)
