# SPDX-License-Identifier: MIT
"""Jobs in flight: at most one per object and per worker, each with a lease, and the slots lent for them.

Pure bookkeeping, without a network or a clock of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from protocol.refused import Refused
from protocol.slots import Slot

SHORTEST = 2.0  # s
LONGEST = 120.0  # s; also for the first job of an object at a worker, which may compile, import and analyse for it
DOUBLINGS = 8
TIMES = 20  # a lease is so many times what the last factorization took
UNKNOWN_PER_BLOCK = 1e-4  # s that nobody else is asked for an object that no factor came of yet
DELIVERED = 1.0  # s in which a job that left reaches a worker through shared memory; as bytes so much longer: ...
BUFFERED, SLOWEST = 1 << 22, 1e6  # ... at most these bytes are still on their way, at so many bytes/s
SOON = 0.5  # s that nobody else is asked, at least
LATE = 2  # late jobs with which a worker may still be asked again through shared memory


class SlotAllocator(Protocol):
    """Where slots come from."""

    def give_back(self, slot: Slot) -> None: ...


@dataclass(frozen=True)
class InFlightJob:
    """One job sent to one worker; deadline [s, monotonic] is the end of its lease, sent its beginning."""

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
    slots: tuple[Slot, ...] = ()
    sent: float = 0.0
    alone: float = 0.0  # [s, monotonic] from when on another worker may be asked for the object
    method: str = "cholesky"
    bytes: int = 0  # of its values, where they are in no slot


class Leases:
    """All flights. A late one stays known, its slots lent, until its worker answers it or a later one, or leaves."""

    def __init__(self, lender: SlotAllocator | None):
        self._lender = lender
        self.by_object: dict[str, InFlightJob] = {}
        self.by_worker: dict[str, InFlightJob] = {}
        self._late: dict[str, list[InFlightJob]] = {}
        self._seconds: dict[str, dict[str, float]] = {}  # of the last factorization, by object and worker
        self._patience: dict[tuple[str, str], int] = {}  # doublings of the lease after late jobs, by object and worker
        self._passed: set[int] = set()  # jobs whose object may go to another worker before they are answered
        self._last = 0

    def next_number(self) -> int:
        """Number of the next job, growing by one."""
        self._last += 1
        return self._last

    def lease(self, object: str, worker: str) -> float:
        """How long [s] an answer of the worker is waited for; twice as long after each one that was late."""
        known = self._seconds.get(object, {}).get(worker)
        if known is None:
            return LONGEST
        return float(min(LONGEST, max(SHORTEST, TIMES * known) * 2 ** self._patience.get((object, worker), 0)))

    def alone(self, object: str, blocks: int) -> float:
        """How long [s] nobody else is asked: by the fastest worker that is known, whoever has the job."""
        known = min(self._seconds.get(object, {}).values(), default=None)
        return max(SOON, TIMES * known) if known is not None else max(SHORTEST, UNKNOWN_PER_BLOCK * blocks)

    def start(self, flight: InFlightJob) -> None:
        """The job is on its way."""
        self.by_object[flight.object] = flight
        self.by_worker[flight.worker] = flight

    def cancel(self, flight: InFlightJob) -> None:
        """The job was never sent."""
        del self.by_object[flight.object], self.by_worker[flight.worker]
        self._give_back(flight)

    def pass_on(self, now: float, able: Callable[[InFlightJob], bool]) -> list[InFlightJob]:
        """Flights of which another worker may be asked, and is there (`able`): their objects may be sent again. Their
        workers stay busy until they answer, which is worth nothing then but to know that they do."""
        slow = [flight for flight in self.by_object.values() if now > flight.alone and able(flight)]
        for flight in slow:
            del self.by_object[flight.object]
            self._passed.add(flight.number)
        return slow

    def passed(self, flight: InFlightJob) -> bool:
        """Its object was passed on."""
        return flight.number in self._passed

    def lateness(self, worker: str) -> int:
        """Late jobs of a worker that it may still be busy with."""
        return len(self._late.get(worker, ()))

    def answered(self, number: int, worker: str, epoch: int) -> InFlightJob:
        """The flight that an answer belongs to, still in flight; raises Refused."""
        flight = self.by_worker.get(worker)
        if flight is not None and flight.number == number:
            if epoch != flight.epoch:
                raise Refused(f"Factor.header.epoch is {epoch}; allowed: {flight.epoch}, as in the matrix", "epoch")
            if self.by_object.get(flight.object) is flight or self.passed(flight):
                return flight
            self.end(flight)
            raise Refused(f"Factor.job is {number} of an epoch of {flight.object} that is over", "epoch")
        late = self._late.get(worker, [])
        if any(old.number == number for old in late):
            self._release_late(worker, number)
            raise Refused(f"Factor.job is {number}, whose lease of worker {worker} is over", "late")
        if 0 < number <= self._last:
            raise Refused(f"Factor.job is {number}, already answered or not for worker {worker}", "duplicate")
        raise Refused(f"Factor.job is {number}; allowed: a job in flight, at most {self._last}", "sequence")

    def end(self, flight: InFlightJob, seconds: float | None = None) -> None:
        """The worker has answered: the object and the worker are free, all slots up to this job come back."""
        if self.by_object.get(flight.object) is flight:
            del self.by_object[flight.object]
        if self.by_worker.get(flight.worker) is flight:
            del self.by_worker[flight.worker]
        self._passed.discard(flight.number)
        self._give_back(flight)
        self._release_late(flight.worker, flight.number)
        if seconds is not None:
            self._seconds.setdefault(flight.object, {})[flight.worker] = seconds
            self._patience.pop((flight.object, flight.worker), None)

    def expire(self, now: float) -> list[InFlightJob]:
        """Flights whose lease ended: object and worker may be used again; the slots stay lent."""
        return self._given_up([flight for flight in self.by_worker.values() if now > flight.deadline])

    def undelivered(
        self, left: Callable[[InFlightJob], float], idle: Callable[[str], tuple[float, float] | None]
    ) -> list[InFlightJob]:
        """Flights that were lost on the way, as if their leases had ended: so says the worker that should have them.

        left: when a job had left [s, monotonic]; idle: from when to when a worker has been saying that it has none.
        """

        def lost(flight: InFlightJob) -> bool:
            said = idle(flight.worker)
            return said is not None and said[1] - max(said[0], left(flight)) > self.delivery(flight)

        return self._given_up([flight for flight in self.by_worker.values() if lost(flight)])

    def delivery(self, flight: InFlightJob) -> float:
        """How long [s] a job that has left may be on its way; twice as long after each one that was late."""
        doublings = self._patience.get((flight.object, flight.worker), 0)
        return float((DELIVERED + min(flight.bytes, BUFFERED) / SLOWEST) * 2**doublings)

    def _given_up(self, over: list[InFlightJob]) -> list[InFlightJob]:
        for flight in over:
            del self.by_worker[flight.worker]
            self._passed.discard(flight.number)
            pair = flight.object, flight.worker
            self._patience[pair] = min(DOUBLINGS, self._patience.get(pair, 0) + 1)
            self._late.setdefault(flight.worker, []).append(flight)
        expired = [flight for flight in over if self.by_object.get(flight.object) is flight]
        for flight in expired:
            del self.by_object[flight.object]
        return expired

    def forget(self, object: str) -> None:
        """The object has a new epoch: what is in flight is worth nothing. Its worker stays busy until it answers."""
        self.by_object.pop(object, None)
        self._seconds.pop(object, None)
        for pair in [pair for pair in self._patience if pair[0] == object]:
            del self._patience[pair]

    def lost(self, worker: str) -> InFlightJob | None:
        """The worker is gone: all its slots come back; the job of a living object that was lost with it."""
        for old in self._late.pop(worker, []):
            self._give_back(old)
        for seconds in self._seconds.values():
            seconds.pop(worker, None)
        for pair in [pair for pair in self._patience if pair[1] == worker]:
            del self._patience[pair]
        flight = self.by_worker.pop(worker, None)
        if flight is None:
            return None
        self._passed.discard(flight.number)
        self._give_back(flight)
        if self.by_object.get(flight.object) is not flight:
            return None
        del self.by_object[flight.object]
        return flight

    def deadlines(self) -> dict[str, float]:
        """By worker, the end of the lease that it works under."""
        return {worker: flight.deadline for worker, flight in self.by_worker.items()}

    def _release_late(self, worker: str, number: int) -> None:
        # A worker does its jobs one after another: having answered this one it writes to no earlier slot.
        late = self._late.get(worker, [])
        for old in [old for old in late if old.number <= number]:
            late.remove(old)
            self._give_back(old)

    def _give_back(self, flight: InFlightJob) -> None:
        if self._lender is not None:
            for slot in flight.slots:
                self._lender.give_back(slot)
