# SPDX-License-Identifier: MIT
"""Jobs in flight: at most one per object, each with a lease and the slots allocated for it.

Pure bookkeeping, without network or clock.
"""

from collections.abc import Callable, Iterable, Sequence
from operator import attrgetter
from typing import Protocol

from protocol.refused import Refused
from protocol.shared_memory.pool import Slot
from sim_server.network.device_slots import DeviceSlot
from sim_server.network.jobs_in_flight import InFlightJob, JobsInFlight
from sim_server.network.lease_terms import DELIVERY, LeaseTerms

MAX_EXPIRED = 2  # expired jobs with which a worker still gets slots of shared memory
BATCH = attrgetter("batch")  # of jobs


class SlotAllocator(Protocol):
    """The pool that slots go back to."""

    def give_back(self, slot: Slot | DeviceSlot, users: int = 1) -> None:
        """Frees a slot that so many jobs used."""


class Leases:
    """All jobs in flight, and jobs whose lease has expired.

    An expired job is kept with its slots until its worker answers it or a later job, or leaves: until then the worker
    may still write to them.
    """

    def __init__(self, allocator: SlotAllocator | None):
        self._allocator = allocator
        self.by_object: dict[str, InFlightJob] = {}
        self.by_worker: dict[str, dict[int, InFlightJob]] = {}  # by number; absent: none
        self._expired: dict[str, list[InFlightJob]] = {}  # by worker
        self.terms = LeaseTerms()
        self._reassigned: set[int] = set()  # numbers of jobs whose object another worker may have
        self._deadlines: dict[str, float] | None = None  # None: to be reckoned anew
        self._next_deadline = float("inf")  # no job in flight has an earlier one
        self._next_exclusive = float("inf")  # no period of a job in flight ends earlier
        self._last = 0

    def next_numbers(self, count: int) -> range:
        """Numbers of the next jobs, increasing by one."""
        self._last += count
        return range(self._last - count + 1, self._last + 1)

    def start(self, batch: JobsInFlight) -> None:
        """Adds jobs that are being sent."""
        worker, deadlines = batch.worker, batch.deadlines
        self.by_object.update(zip(batch.objects, batch.jobs, strict=True))
        self.by_worker.setdefault(worker, {}).update(zip(batch.numbers, batch.jobs, strict=True))
        batch.jobs = []
        self._next_deadline = min(self._next_deadline, float(deadlines.min()))
        self._next_exclusive = min(self._next_exclusive, float(batch.exclusive_until.min()))
        if self._deadlines is not None:
            self._deadlines[worker] = max(self._deadlines.get(worker, 0.0), float(deadlines.max()))

    def cancel(self, batch: JobsInFlight) -> None:
        """Removes jobs that were never sent."""
        for object in batch.objects:
            del self.by_object[object]
        self._drop(batch, batch.numbers)
        self._free_slots(batch, len(batch))

    def _drop(self, batch: JobsInFlight, numbers: Iterable[int]) -> None:
        """Removes jobs of a batch from those of their worker."""
        worker, latest = batch.worker, float(batch.deadlines.max())
        jobs = self.by_worker.get(worker, {})
        for number in numbers:
            jobs.pop(number, None)
        if self._deadlines is not None and latest >= self._deadlines.get(worker, latest):
            self._deadlines = None  # the latest one may be another now
        if not jobs:
            self.by_worker.pop(worker, None)
            self._deadlines = None

    def count(self, worker: str) -> int:
        """Number of jobs in flight at a worker."""
        return len(self.by_worker.get(worker, ()))

    @property
    def jobs(self) -> list[InFlightJob]:
        """All jobs in flight."""
        return [job for jobs in self.by_worker.values() for job in jobs.values()]

    def reassign(self, now: float, can_move: Callable[[InFlightJob], bool]) -> list[InFlightJob]:
        """Frees the objects of jobs whose exclusive period is over, if another worker could take them (`can_move`).

        Their workers stay busy until they answer; that answer is dropped.
        """
        if now <= self._next_exclusive:
            return []
        slow = [job for job in self.by_object.values() if now > job.exclusive_until and can_move(job)]
        for job in slow:
            del self.by_object[job.object]
            self._reassigned.add(job.number)
        self._next_exclusive = min((job.exclusive_until for job in self.by_object.values()), default=float("inf"))
        return slow

    def is_in_flight(self, job: InFlightJob) -> bool:
        """True while a job is neither answered nor given up."""
        return self.by_worker.get(job.worker, {}).get(job.number) is job

    def is_reassigned(self, job: InFlightJob) -> bool:
        """True if the object of the job was freed by `reassign`."""
        return job.number in self._reassigned

    def expired_count(self, worker: str) -> int:
        """Number of expired jobs that a worker may still be busy with."""
        return len(self._expired.get(worker, ()))

    def match_answer(self, number: int, worker: str, epoch: int | None) -> InFlightJob:
        """Finds the job in flight that an answer belongs to; raises Refused if there is none. epoch: None: not told"""
        job = self.by_worker.get(worker, {}).get(number)
        if job is not None:
            if epoch is not None and epoch != job.epoch:
                raise Refused(f"Factor.header.epoch is {epoch}; allowed: {job.epoch}, as in the matrix", "epoch")
            if self.by_object.get(job.object) is job or self.is_reassigned(job):
                return job
            self.finish(job)
            raise Refused(f"Factor.job is {number} of an epoch of {job.object} that is over", "epoch")
        if any(old.number == number for old in self._expired.get(worker, [])):
            self._free_expired(worker, number)
            raise Refused(f"Factor.job is {number}, whose lease of worker {worker} is over", "late")
        if 0 < number <= self._last:
            raise Refused(f"Factor.job is {number}, already answered or not for worker {worker}", "duplicate")
        raise Refused(f"Factor.job is {number}; allowed: a job in flight, at most {self._last}", "sequence")

    def finish(self, job: InFlightJob, seconds: float | None = None) -> None:
        """Removes a job that its worker has answered, and frees all slots of the worker up to this job.

        seconds: duration of the factorization; None if it failed
        """
        self._end([job])
        if seconds is not None:
            self.terms.on_factors(job.batch, [job.object], [seconds])

    def finish_all(self, jobs: Sequence[InFlightJob], seconds: Sequence[float]) -> None:
        """Removes jobs of one batch that its worker has answered with factors in one message, as `finish` does each."""
        self._end(jobs)
        self.terms.on_factors(jobs[0].batch, [job.object for job in jobs], seconds)

    def _end(self, jobs: Sequence[InFlightJob]) -> None:
        """Removes answered jobs of one batch, and frees all slots of its worker up to the last one."""
        batch, numbers, held = jobs[0].batch, [job.number for job in jobs], self.by_object
        for job in jobs:
            if held.get(job.object) is job:
                del held[job.object]
        self._drop(batch, numbers)
        if self._reassigned:
            self._reassigned.difference_update(numbers)
        self._free_slots(batch, len(jobs))
        if batch.worker in self._expired:
            self._free_expired(batch.worker, max(numbers))

    def over(self, now: float, is_answered: Callable[[InFlightJob], bool] = lambda job: False) -> list[InFlightJob]:
        """Returns the jobs whose leases `expire` would end.

        is_answered: the answer is there, and is taken in
        """
        if now <= self._next_deadline:
            return []
        return [job for job in self.jobs if now > job.deadline and not is_answered(job)]

    def expire(self, now: float, is_answered: Callable[[InFlightJob], bool] = lambda job: False) -> list[InFlightJob]:
        """Ends the leases that are over: objects and workers are free again, the slots are not. Returns the jobs that
        are of the present epoch of their objects. is_answered: as of `over`"""
        if now <= self._next_deadline:
            return []
        expired = self._expire(self.over(now, is_answered))
        self._next_deadline = min((job.deadline for job in self.jobs), default=float("inf"))
        return expired

    def expire_undelivered(
        self, sent_at: Callable[[InFlightJob], float], idle: Callable[[str], tuple[float, float] | None]
    ) -> list[InFlightJob]:
        """Ends the leases of jobs that were lost on the way: their workers keep reporting that they have no job.

        sent_at: time [s, monotonic] at which the network took a job
        idle: first and last time [s, monotonic] at which a worker reported without a break that it has no job
        """

        lost = []
        for worker, jobs in self.by_worker.items():
            if (period := idle(worker)) is not None and period[1] - period[0] > DELIVERY:
                since = [(job, period[1] - max(period[0], sent_at(job))) for job in jobs.values()]
                lost += [job for job, seconds in since if seconds > self.terms.delivery_time(job)]
        return self._expire(lost)

    def _expire(self, over: list[InFlightJob]) -> list[InFlightJob]:
        for job in over:
            self._drop(job.batch, [job.number])
            self._reassigned.discard(job.number)
            self.terms.on_expired(job)
            self._expired.setdefault(job.worker, []).append(job)
        expired = [job for job in over if self.by_object.get(job.object) is job]
        for job in expired:
            del self.by_object[job.object]
        return expired

    def forget_object(self, object: str) -> None:
        """Drops what is known of an object that has a new epoch. The worker of its job stays busy until it answers."""
        self.by_object.pop(object, None)
        self.terms.forget_object(object)

    def remove_worker(self, worker: str) -> list[InFlightJob]:
        """Frees all slots of a worker that left; returns its jobs that are of the present epoch of their objects."""
        for old in self._expired.pop(worker, []):
            self._free_slots(old.batch, 1)
        self.terms.forget_worker(worker)
        jobs = list(self.by_worker.pop(worker, {}).values())
        self._deadlines = None
        for job in jobs:
            self._reassigned.discard(job.number)
            self._free_slots(job.batch, 1)
        lost = [job for job in jobs if self.by_object.get(job.object) is job]
        for job in lost:
            del self.by_object[job.object]
        return lost

    def deadlines(self) -> dict[str, float]:
        """End of the lease [s, monotonic] of each busy worker: the latest one of the messages with jobs in flight."""
        if self._deadlines is None:
            every = self.by_worker.items()
            self._deadlines = {worker: _latest(jobs.values()) for worker, jobs in every}
        return self._deadlines

    def _free_expired(self, worker: str, number: int) -> None:
        # A worker does its jobs in about the order in which they came: having answered this one it hardly writes to a
        # slot of an earlier one whose lease is over, and what it would spoil then does not fit its checksum.
        expired = self._expired.get(worker, [])
        for old in [old for old in expired if old.number <= number]:
            expired.remove(old)
            self._free_slots(old.batch, 1)

    def _free_slots(self, batch: JobsInFlight, jobs: int) -> None:
        """Frees the slots of so many jobs of a batch, which all of its jobs share."""
        if self._allocator is not None:
            for slot in batch.slots:
                self._allocator.give_back(slot, jobs)


def _latest(jobs: Iterable[InFlightJob]) -> float:
    """End of the last lease of the batches of jobs [s, monotonic]."""
    return max(float(batch.deadlines.max()) for batch in set(map(BATCH, jobs)))
