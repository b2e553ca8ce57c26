# SPDX-License-Identifier: MIT
"""What is noted of answers of workers: of factors that passed all checks, and of others. For one thread at a time."""

from collections.abc import Callable, Sequence

from protocol.counters import Counters
from protocol.factor import Factor
from protocol.refused import Refused
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.jobs_in_flight import InFlightJob


class Answers:
    """Notes answers to jobs.

    factors: that came alone and passed all checks, until they are told
    """

    def __init__(self, counters: Counters, book: Bookkeeping):
        self._counters, self._book = counters, book
        self.factors: list[Factor] = []

    def note(self, worker: str) -> None:
        """Takes note that a worker has answered."""
        self._book.free_since[worker] = self._book.clock()
        self._book.reliability.on_answer(worker)

    def duration(self, job: InFlightJob, now: float) -> float:
        """Time [s] from matrix to factor, without that for which the job waited behind others of its worker. now: when
        the factor came [s, monotonic]"""
        last = self._book.answered_at.get(job.worker, 0.0)
        self._book.answered_at[job.worker] = max(last, now)
        return max(0.0, now - max(job.sent_at, last))

    def guarded(self, jobs: Sequence[InFlightJob], take: Callable[[], None]) -> None:
        """Takes in the answers to some jobs. Whatever error that ends with, the jobs are over and the run goes on."""
        try:
            return take()
        except Refused as error:
            refusal = error
        except Exception as error:
            and_more = f" and {len(jobs) - 1} more" if len(jobs) > 1 else ""
            what = f"factor of {jobs[0].object}{and_more} by worker {jobs[0].worker}"
            refusal = self._counters.unexpected(error, what)
        self._counters.refuse(refusal)
        leases = self._book.leases
        for job in jobs:
            if leases.is_in_flight(job):
                if leases.by_object.get(job.object) is job:
                    self._book.fail(job, f"was refused: {refusal}")
                leases.finish(job)

    def take(
        self, job: InFlightJob, decode: Callable[[], Factor], failure: str, told: float, by_slot: tuple[bool, bool]
    ) -> None:  # fmt: skip
        """Takes the answer to a job: the factor that `decode` returns, or a failure. Raises Refused.

        told: time [s] of the factorization, by the worker
        by_slot: matrix and factor travelled in shared memory
        """
        book, seconds = self._book, None
        try:
            if failure:
                self._counters.add("failures")
                book.reliability.on_failure(job.worker, job.object, book.clock())
                return book.fail(job, f"failed: {failure[:500]}")
            self.factors.append(decode())
            seconds = told
            book.timing.record(job.worker, job.object, self.duration(job, book.clock()), seconds)
        except Refused as refusal:
            if refusal.kind != "unexpected":  # which may well be an error of this process, and last
                book.reliability.on_failure(job.worker, job.object, book.clock())
            book.fail(job, f"was refused: {refusal}")
            raise
        finally:
            book.leases.finish(job, seconds)
        self.count(job, self.factors[-1].values.nbytes, by_slot)

    def refuse(self, job: InFlightJob, refusal: Refused, by_slot: tuple[bool, bool]) -> None:
        """Takes note that the factor of a job did not pass a check."""
        try:
            self.take(job, _raising(refusal), "", 0.0, by_slot)
        except Refused as told:
            self._counters.refuse(told)

    def fail(self, job: InFlightJob, failure: str) -> None:
        """Takes note that a worker made no factor, and why."""
        self.take(job, _raising(Refused("there is no factor", "malformed")), failure, 0.0, (True, True))

    def count(self, job: InFlightJob, size: int, by_slot: tuple[bool, bool], factors: int = 1) -> None:
        """Counts factors of `size` bytes together, and how they and their matrices travelled. job: one of theirs"""
        self._counters.add("factors", factors)
        self._counters.add("bytes_in", size)
        capacity = job.factor_slot.capacity if job.factor_slot is not None else 0
        fits = 0 < size <= capacity  # an incomplete factor may be the largest so far
        for what, shared, allocated in (("matrix", by_slot[0], bool(job.slots)), ("factor", by_slot[1], fits)):
            self._counters.add("bulk_shared" if shared else "bulk_copied", factors)
            self._counters.add("bulk_on_device", factors if shared and job.device_slot is not None else 0)
            if allocated and not shared:
                self._counters.add("slots_unused", factors - 1)
                self._counters.trouble(
                    "slots_unused", f"a slot was lent to worker {job.worker}, but its {what} travelled as bytes"
                )


def _raising(refusal: Refused) -> Callable[[], Factor]:
    def raises() -> Factor:
        raise refusal

    return raises
