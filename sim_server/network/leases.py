# SPDX-License-Identifier: MIT
"""Jobs in flight: at most one per object, each with a lease and the slots allocated for it.

Pure bookkeeping, without network or clock.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Protocol

from protocol.refused import Refused
from protocol.shared_memory.pool import Slot
from sim_server.network.device_slots import DeviceSlot

MIN_LEASE = 2.0  # s
MAX_LEASE = 120.0  # s; also for the first job of an object at a worker, which may compile, import and analyse for it
LEASE_BLOCKS = 500_000  # of a matrix, above which the longest lease grows as the operations of a factor, blocks^2
MAX_DOUBLINGS = 8  # of a lease
LEASE_FACTOR = 20  # a lease is this multiple of the duration of the last factorization
EXCLUSIVE_PER_BLOCK = 1e-4  # s per block of the matrix: exclusive period of an object without any factor yet
MIN_EXCLUSIVE = 0.5  # s; least exclusive period of an object with a factor
DELIVERY = 1.0  # s in which a job that was sent reaches its worker, without the time for bytes
BUFFERED = 1 << 22  # bytes that may still be under way when a job was sent
MIN_BANDWIDTH = 1e6  # bytes/s of the slowest link
MAX_EXPIRED = 2  # expired jobs with which a worker still gets slots of shared memory


NUMBER, DEADLINE, SLOTS = attrgetter("number"), attrgetter("deadline"), attrgetter("slots")  # of jobs


class SlotAllocator(Protocol):
    """The pool that slots go back to."""

    def give_back(self, slot: Slot | DeviceSlot, users: int = 1) -> None:
        """Frees a slot that so many jobs used."""


@dataclass(eq=False, slots=True)
class InFlightJob:
    """A job sent to one worker, which does not change. Times are monotonic [s].

    number: of the job, unique in the life of the server
    sent_at, deadline: begin and end of its lease
    exclusive_until: from then on another worker may be asked for the object
    slots: shared memory allocated for the matrix and the factor, of the host or of a device
    room: bytes of the factor slot that are for this job, from `first` on
    payload_bytes: size of the values if they are in no slot
    positions: they are positions, from which the worker assembles the matrix
    part_bytes: of each part of a factor that travels in parts
    device_slot, device_generation: in place of factor_slot, of a device
    """

    number: int
    object: str
    epoch: int
    step: int
    warp: bool
    dtype: str
    worker: str
    deadline: float
    factor_slot: Slot | None = None
    factor_generation: int = 0
    slots: tuple[Slot | DeviceSlot, ...] = ()
    first: int = 0
    room: int = 0
    sent_at: float = 0.0
    exclusive_until: float = 0.0
    method: str = "cholesky"
    payload_bytes: int = 0
    positions: bool = False
    part_bytes: int = 0
    device_slot: DeviceSlot | None = None
    device_generation: int = 0


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
        self._seconds: dict[str, dict[str, float]] = {}  # duration of the last factorization, by object and worker
        self._answered: dict[tuple[str, str], set[tuple[str, bool]]] = {}  # methods, and whether it assembled, likewise
        self._doublings: dict[tuple[str, str], int] = {}  # of the lease, after expired jobs, by object and worker
        self._reassigned: set[int] = set()  # numbers of jobs whose object another worker may have
        self._deadlines: dict[str, float] | None = None  # None: to be reckoned anew
        self._next_deadline = float("inf")  # no job in flight has an earlier one
        self._last = 0

    def next_number(self) -> int:
        """Number of the next job, increasing by one."""
        self._last += 1
        return self._last

    def lease(
        self, object: str, worker: str, method: str = "cholesky", positions: bool = False, blocks: int = 0
    ) -> float:
        """Time [s] that the worker has for its answer; doubled after each job that expired.

        The longest there is, MAX_LEASE and more for large matrices, for the first job of an object by a method, and the
        first that it assembles itself: it may import and compile for that.
        """
        longest = MAX_LEASE * max(1.0, (blocks / LEASE_BLOCKS) ** 2)
        known = self._seconds.get(object, {}).get(worker)
        if known is None or (method, positions) not in self._answered.get((object, worker), ()):
            return longest
        doublings = self._doublings.get((object, worker), 0)
        return float(min(longest, max(MIN_LEASE, LEASE_FACTOR * known) * 2**doublings))

    def terms(self, objects: Sequence[tuple[str, int]], worker: str, method: str) -> tuple[list[float], list[float]]:
        """Returns `lease` and `exclusive_period` of each of some objects, whose matrices are sent. objects: names, and
        blocks of their matrices"""
        leases: list[float] = []
        periods: list[float] = []
        wanted = method, False
        for name, blocks in objects:
            seconds, pair = self._seconds.get(name), (name, worker)
            if not seconds or len(seconds) > 1 or worker not in seconds or pair in self._doublings:
                leases.append(self.lease(name, worker, method))
                periods.append(self.exclusive_period(name, blocks))
                continue
            usual = LEASE_FACTOR * seconds[worker]
            known = wanted in self._answered.get(pair, ())
            leases.append(min(MAX_LEASE, max(MIN_LEASE, usual)) if known else MAX_LEASE)
            periods.append(max(MIN_EXCLUSIVE, usual))
        return leases, periods

    def exclusive_period(self, object: str, blocks: int) -> float:
        """Time [s] in which no other worker is asked for the object, by the duration at its fastest known worker."""
        known = min(self._seconds.get(object, {}).values(), default=None)
        if known is None:
            return max(MIN_LEASE, EXCLUSIVE_PER_BLOCK * blocks)
        return max(MIN_EXCLUSIVE, LEASE_FACTOR * known)

    def start(self, job: InFlightJob) -> None:
        """Adds a job that is being sent."""
        self.start_all([job])

    def start_all(self, jobs: Sequence[InFlightJob]) -> None:
        """Adds jobs that are being sent to one worker."""
        worker, deadlines = jobs[0].worker, [job.deadline for job in jobs]
        self.by_object.update((job.object, job) for job in jobs)
        self.by_worker.setdefault(worker, {}).update((job.number, job) for job in jobs)
        self._next_deadline = min(self._next_deadline, *deadlines)
        if self._deadlines is not None:
            self._deadlines[worker] = max(self._deadlines.get(worker, deadlines[0]), *deadlines)

    def cancel(self, job: InFlightJob) -> None:
        """Removes a job that was never sent."""
        del self.by_object[job.object]
        self._drop([job])
        self._free_slots([job])

    def _drop(self, dropped: Sequence[InFlightJob]) -> None:
        """Removes jobs from those of their worker."""
        worker = dropped[0].worker
        jobs = self.by_worker.get(worker, {})
        for job in dropped:
            jobs.pop(job.number, None)
        latest = max(map(DEADLINE, dropped))
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
        slow = [job for job in self.by_object.values() if now > job.exclusive_until and can_move(job)]
        for job in slow:
            del self.by_object[job.object]
            self._reassigned.add(job.number)
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
            self._remember(job, seconds)

    def finish_all(self, jobs: Sequence[InFlightJob], seconds: Sequence[float]) -> None:
        """Removes jobs of one worker that it has answered with factors in one message, as `finish` does each."""
        self._end(jobs)
        for job, lasted in zip(jobs, seconds, strict=True):
            self._remember(job, lasted)

    def _end(self, jobs: Sequence[InFlightJob]) -> None:
        """Removes answered jobs of one worker, and frees all of its slots up to the last one."""
        for job in jobs:
            if self.by_object.get(job.object) is job:
                del self.by_object[job.object]
        self._drop(jobs)
        self._reassigned.difference_update(map(NUMBER, jobs))
        self._free_slots(jobs)
        self._free_expired(jobs[0].worker, max(map(NUMBER, jobs)))

    def _remember(self, job: InFlightJob, seconds: float) -> None:
        """Takes note of how long a factorization took, by which later leases go."""
        pair, answer = (job.object, job.worker), (job.method, job.positions)
        if (known := self._seconds.get(job.object)) is None:
            known = self._seconds[job.object] = {}
        known[job.worker] = seconds
        if (answered := self._answered.get(pair)) is None:
            answered = self._answered[pair] = set()
        answered.add(answer)
        if self._doublings:
            self._doublings.pop(pair, None)

    def expire(self, now: float, is_answered: Callable[[InFlightJob], bool] = lambda job: False) -> list[InFlightJob]:
        """Ends the leases that are over: objects and workers are free again, the slots are not. Returns the jobs.

        is_answered: the answer is there, and is taken in
        """
        if now <= self._next_deadline:
            return []
        over = [job for job in self.jobs if now > job.deadline and not is_answered(job)]
        expired = self._expire(over)
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
                lost += [job for job, seconds in since if seconds > self.delivery_time(job)]
        return self._expire(lost)

    def delivery_time(self, job: InFlightJob) -> float:
        """Time [s] that a job may need to reach its worker; doubled after each job that expired."""
        doublings = self._doublings.get((job.object, job.worker), 0)
        return float((DELIVERY + min(job.payload_bytes, BUFFERED) / MIN_BANDWIDTH) * 2**doublings)

    def _expire(self, over: list[InFlightJob]) -> list[InFlightJob]:
        for job in over:
            self._drop([job])
            self._reassigned.discard(job.number)
            pair = job.object, job.worker
            self._doublings[pair] = min(MAX_DOUBLINGS, self._doublings.get(pair, 0) + 1)
            self._expired.setdefault(job.worker, []).append(job)
        expired = [job for job in over if self.by_object.get(job.object) is job]
        for job in expired:
            del self.by_object[job.object]
        return expired

    def forget_object(self, object: str) -> None:
        """Drops what is known of an object that has a new epoch. The worker of its job stays busy until it answers."""
        self.by_object.pop(object, None)
        self._seconds.pop(object, None)
        for known in (self._doublings, self._answered):
            for pair in [pair for pair in known if pair[0] == object]:
                del known[pair]

    def remove_worker(self, worker: str) -> list[InFlightJob]:
        """Frees all slots of a worker that left; returns its jobs that are of the present epoch of their objects."""
        for old in self._expired.pop(worker, []):
            self._free_slots([old])
        for seconds in self._seconds.values():
            seconds.pop(worker, None)
        for known in (self._doublings, self._answered):
            for pair in [pair for pair in known if pair[1] == worker]:
                del known[pair]
        jobs = list(self.by_worker.pop(worker, {}).values())
        self._deadlines = None
        for job in jobs:
            self._reassigned.discard(job.number)
            self._free_slots([job])
        lost = [job for job in jobs if self.by_object.get(job.object) is job]
        for job in lost:
            del self.by_object[job.object]
        return lost

    def deadlines(self) -> dict[str, float]:
        """End of the lease [s, monotonic] of each busy worker."""
        if self._deadlines is None:
            every = self.by_worker.items()
            self._deadlines = {worker: max(job.deadline for job in jobs.values()) for worker, jobs in every}
        return self._deadlines

    def _free_expired(self, worker: str, number: int) -> None:
        # A worker does its jobs in about the order in which they came: having answered this one it hardly writes to a
        # slot of an earlier one whose lease is over, and what it would spoil then does not fit its checksum.
        expired = self._expired.get(worker, [])
        for old in [old for old in expired if old.number <= number]:
            expired.remove(old)
            self._free_slots([old])

    def _free_slots(self, jobs: Sequence[InFlightJob]) -> None:
        if self._allocator is not None:
            for slots, users in Counter(map(SLOTS, jobs)).items():  # those of a batch have the same
                for slot in slots:
                    self._allocator.give_back(slot, users)
