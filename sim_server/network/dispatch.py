# SPDX-License-Identifier: MIT
"""Matrices out to workers, factors back: who gets a job, and what becomes of it."""

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import zenoh

from protocol import Factor
from protocol.channels import CHANNELS, key, name_in
from protocol.check import take
from protocol.counters import Counters
from protocol.messages_pb2 import Topology, WorkerInfo
from protocol.refused import Refused
from protocol.slots import Slot, SlotPool
from sim_server.network.factor_decoder import FactorDecoder
from sim_server.network.inbox import Inbox
from sim_server.network.job_message import load, matrix_message
from sim_server.network.leases import LATE, InFlightJob, Leases
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming

if TYPE_CHECKING:
    from sim_server.factors import Job

log = logging.getLogger(__name__)

LOOK_AGAIN = 1.0  # s between questions for tokens that were not told
QUICK = 0.05  # s in which a link takes a job as bytes if it is fast; zenoh drops what is not taken within 0.25
ROOM = 8  # a slot for an incomplete factor is larger than the last ones by one part in so many


class Dispatch:
    """Jobs, workers and answers of one server. Methods may be called from any thread; none waits for the network."""

    def __init__(
        self,
        session: zenoh.Session,
        server: str,
        incarnation: int,
        pool: SlotPool | None,
        outbox: SendQueue,
        counters: Counters,
        silence: float,
        clock: Callable[[], float],
    ):
        self._session, self._server, self._incarnation = session, server, incarnation
        self._pool, self._outbox, self._counters, self._clock = pool, outbox, counters, clock
        self._answers = FactorDecoder(incarnation)
        self._roster = WorkerRegistry(incarnation, silence)
        self._jobs = Leases(pool)
        self._speeds = WorkerTiming()
        self._conduct = WorkerReliability()
        self._busy = threading.RLock()  # a status asks for the workers while the loop thread takes in a factor
        self._last_worker: dict[str, str] = {}  # of each object: it knows the pattern already
        self._free_since: dict[str, float] = {}  # by worker, when it last answered
        self._left: dict[str, tuple[int, float]] = {}  # by worker, the last job that left for it, and when
        self._quick: set[str] = set()  # workers without shared memory whose link takes a job at once
        self._factors: list[Factor] = []
        self._failures: list[tuple[str, str]] = []
        self._arrivals = Inbox(session, server)
        self._look_due = 0.0
        self._take_in: dict[str, Callable[[zenoh.Sample], None]] = {
            "worker": self._take_hello,
            "pattern": self._take_pattern,
            "factor": self._take_factor,
            "alive_worker": self._take_token,
        }

    def announce(self, topology: Topology) -> None:
        """A new epoch of an object."""
        with self._busy:
            self._answers.announce(topology)
            self._jobs.forget(topology.header.object)
            self._speeds.forget_object(topology.header.object)
            self._conduct.forget_object(topology.header.object)

    def ready(self) -> int:
        """How many are idle and can take a job."""
        with self._busy:
            self._receive()
            return len(self._idle())

    def ahead(self) -> int:
        """How many of the most urgent objects are left for faster workers that are about to be free."""
        with self._busy:
            now = self._clock()
            idle = [(name, now - self._free_since.get(name, 0.0)) for name in self._idle()]
            busy = [(f.worker, f.object, now - f.sent) for f in self._jobs.by_worker.values()]
            return self._speeds.ahead(idle, busy)

    def workers(self) -> list[WorkerInfo]:
        """Workers that may be given work."""
        with self._busy:
            self._receive()
            infos = (self._roster.info(name) for name in self._fit())
            return [info for info in infos if info is not None]

    def builds(self) -> bool:
        """There are workers, and all of them can assemble matrices from positions."""
        infos = self.workers()
        return bool(infos) and all(info.builds for info in infos)

    def poll(self) -> list[Factor]:
        """Good factors since the last call."""
        with self._busy:
            self._receive()
            factors, self._factors = self._factors, []
            return factors

    def failures(self) -> list[tuple[str, str]]:
        """(object, reason) of jobs that ended without a factor since the last call."""
        with self._busy:
            failures, self._failures = self._failures, []
            return failures

    def taken_back(self) -> list[str]:
        """Objects whose worker takes its time while another one is idle: they may be sent again at once."""
        with self._busy:
            slow = self._jobs.pass_on(self._clock(), self._another)
            self._counters.add("passed_on", len(slow))
            return [flight.object for flight in slow]

    def no_use(self, worker: str, object: str) -> None:
        """A factor of a worker was refused, or solves had to leave it."""
        with self._busy:
            self._conduct.failed(worker, object, self._clock())

    def of_use(self, worker: str, object: str) -> None:
        """A solve was made with a factor of a worker."""
        with self._busy:
            self._conduct.helped(worker, object)

    def setbacks(self) -> dict[str, int]:
        """By object, jobs in a row that came to nothing with the best of its workers."""
        with self._busy:
            failing = self._conduct.failing
            fit = self._fit() if failing else []
            return {object: self._conduct.failures(fit, object) for object in failing}

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors of the idle ones came to nothing."""
        with self._busy:
            failing = self._conduct.failing
            if not failing:
                return set()
            idle, fit = self._idle(), self._fit()
            return {object for object in failing if idle and not self._candidates(idle, fit, object)}

    # ---- out -------------------------------------------------------------------------------------------------

    def submit(self, job: "Job") -> bool:
        """Send a job to an idle worker; False if there is none or the object is in flight."""
        with self._busy:
            return self._submit(job)

    def _submit(self, job: "Job") -> bool:
        known = self._answers.known.get(job.object)
        if known is None or known.epoch != job.epoch:
            raise ValueError(f"job for {job.object} epoch {job.epoch}, which was not announced")
        shape = (known.size // 3, 3) if job.positions else (known.blocks, 3, 3)
        if job.values.shape != shape or job.values.dtype != np.float64:
            raise ValueError(f"job for {job.object}: values {job.values.shape}, allowed: float64 {shape}")
        self._receive()
        idle = [name for name in self._idle() if not job.positions or self._builds(name)]
        idle = self._candidates(idle, self._fit(), job.object)
        if job.object in self._jobs.by_object or not idle:
            return False
        worker = self._choose(idle, job.object)
        matrix_slot, factor_slot = self._lend(worker, job)
        lease, now = self._jobs.lease(job.object, worker), self._clock()
        flight = InFlightJob(
            self._jobs.next_number(),
            job.object,
            job.epoch,
            job.step,
            job.warp,
            np.dtype(job.dtype).name,
            worker,
            now + lease,
            factor_slot,
            factor_slot.generation if factor_slot else 0,
            tuple(slot for slot in (matrix_slot, factor_slot) if slot is not None),
            now,
            now + self._jobs.alone(job.object, known.blocks),
            job.method.name,
            0 if matrix_slot else job.values.nbytes,
        )
        self._jobs.start(flight)
        if self._post(flight, job, lease, matrix_slot):
            self._last_worker[job.object] = worker
            self._conduct.sent(worker, now)
            self._counters.add("jobs")
            self._counters.add("bytes_out", job.values.nbytes)
            return True
        self._jobs.cancel(flight)
        return False

    def _fit(self) -> list[str]:
        return self._roster.fit(self._clock(), self._jobs.deadlines())

    def _idle(self) -> list[str]:
        fit, now = self._fit(), self._clock()
        idle = [name for name in fit if name not in self._jobs.by_worker]
        return [name for name in idle if self._conduct.may_be_asked(name, fit, now)]

    def _candidates(self, idle: list[str], fit: list[str], object: str) -> list[str]:
        """Idle workers whose factors of the object are not no use; all of them if those of everybody are."""
        now = self._clock()
        good = [name for name in fit if not self._conduct.held(name, object, now)]
        return [name for name in idle if name in good] if good else idle

    def _another(self, flight: InFlightJob) -> bool:
        """Somebody else could take the object of a flight."""
        return bool(self._candidates(self._idle(), self._fit(), flight.object))

    def _builds(self, worker: str) -> bool:
        info = self._roster.info(worker)
        return info is not None and info.builds

    def _choose(self, idle: list[str], object: str) -> str:
        """Nobody late if it can be helped; then the fastest; then who knows the object; then who did least."""

        def rank(name: str) -> tuple[int, float, bool, int]:
            info = self._roster.info(name)
            late, expected = self._jobs.lateness(name), self._speeds.expected(name, object)
            return late, expected, self._last_worker.get(object) != name, info.jobs if info else 0

        return min(idle, key=rank)

    def _lend(self, worker: str, job: "Job") -> tuple[Slot | None, Slot | None]:
        """Slots for the matrix and its factor; None for what must travel as bytes."""
        info = self._roster.info(worker)
        if self._pool is None or info is None or not info.shared_memory or self._jobs.lateness(worker) >= LATE:
            return None, None
        nonzeros = self._answers.known[job.object].largest.get(job.method.name, 0)
        if job.method.name == "incomplete_cholesky":
            nonzeros += nonzeros // ROOM  # the next one may keep more
        matrix = self._pool.lend(job.values.nbytes)
        factor = self._pool.lend(nonzeros * np.dtype(job.dtype).itemsize) if nonzeros else None
        if matrix is None or (nonzeros and factor is None):
            self._counters.trouble("slots_exhausted", "no slot of shared memory is left, an array travels as bytes")
        return matrix, factor

    def _post(self, flight: InFlightJob, job: "Job", lease: float, slot: Slot | None) -> bool:
        message = matrix_message(flight, self._answers.known[job.object], self._incarnation, lease, job.method)
        payload = load(message, job.values, slot)
        name = key("matrix", self._server, worker=flight.worker, object=flight.object)
        attachment = message.SerializeToString()
        return self._outbox.post(lambda: self._send(flight, name, payload, attachment, slot is not None))

    def _send(self, flight: InFlightJob, name: str, payload: Any, attachment: bytes, shared: bool) -> None:
        """Send a job, in the thread of the outbox. Where a link is full zenoh drops it (the lease then ends) or waits.

        It waits only where it must: bytes over a link that is slow, as far as is known, are more than zenoh would hold.
        While it waits for one receiver all others wait too, also for one that subscribed to everything and stopped
        reading. In a queue of its own, since a message that waits locks the queue of its priority.
        """
        drop = shared or flight.worker in self._quick
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        begin = time.perf_counter()
        self._session.put(
            name, payload, attachment=attachment, congestion_control=control, priority=zenoh.Priority.BACKGROUND
        )
        if not drop and time.perf_counter() - begin < QUICK:
            self._quick.add(flight.worker)
        self._left[flight.worker] = flight.number, self._clock()

    # ---- in --------------------------------------------------------------------------------------------------

    def _receive(self) -> None:
        """Take in all that arrived; refuse what is wrong; end leases."""
        for channel, sample in self._arrivals:
            try:
                self._take_in[channel](sample)
            except Refused as refusal:
                self._counters.refuse(refusal)
        self._look_again()
        for flight in self._jobs.expire(self._clock()):
            self._counters.add("leases_over")
            self._give_up(flight, "was not answered within its lease")
        for flight in self._jobs.undelivered(self._left_at, self._roster.idle):
            self._counters.add("jobs_lost")
            self._give_up(flight, f"was lost: worker {flight.worker} says that it has no job")

    def _left_at(self, flight: InFlightJob) -> float:
        number, when = self._left.get(flight.worker, (0, 0.0))
        return when if number == flight.number else float("inf")

    def _give_up(self, flight: InFlightJob, why: str) -> None:
        self._quick.discard(flight.worker)  # it may be that zenoh dropped it
        self._conduct.failed(flight.worker, flight.object, self._clock())
        self._fail(flight, why)

    def _look_again(self) -> None:
        """Ask for the tokens of workers that speak without one, now and then."""
        now = self._clock()
        if now >= self._look_due:
            self._look_due = now + LOOK_AGAIN
            if wanted := self._roster.without_token(now):
                self._arrivals.ask_for_tokens(wanted)

    def _take_token(self, sample: zenoh.Sample) -> None:
        name = name_in("alive_worker", sample.key_expr, "worker")
        if self._roster.token(name, sample.kind == zenoh.SampleKind.PUT):
            self._leave(name)

    def _take_hello(self, sample: zenoh.Sample) -> None:
        data = take(sample.payload, CHANNELS["worker"].limit, "WorkerInfo")
        name, new, lost = self._roster.hello(sample.key_expr, data, self._clock(), self._jobs.deadlines())
        if lost:
            self._leave(lost)
        if new:
            self._leave(name)  # what an earlier process of this name had in hand is lost
            info = self._roster.info(name)
            log.info("worker %s joined: %s", name, info.library if info else "")
            if info and self._pool is not None and not info.shared_memory:
                self._counters.warn("worker_copies", f"worker {name} has no shared memory with us, arrays are copied")

    def _leave(self, name: str) -> None:
        flight = self._jobs.lost(name)
        self._speeds.forget_worker(name)
        self._conduct.forget_worker(name)
        self._quick.discard(name)
        self._left.pop(name, None)
        self._free_since.pop(name, None)
        if flight is not None:
            self._counters.add("jobs_lost")
            self._fail(flight, f"was lost with worker {name}")

    def _take_pattern(self, sample: zenoh.Sample) -> None:
        self._answers.take_pattern(sample.key_expr, sample.payload)

    def _take_factor(self, sample: zenoh.Sample) -> None:
        message = self._answers.parse_factor(sample.key_expr, sample.attachment)
        flight = self._jobs.answered(message.job, message.worker, message.header.epoch)
        now, seconds = self._clock(), None
        self._roster.heard(flight.worker, now)
        self._free_since[flight.worker] = now
        self._conduct.answered(flight.worker)
        if self._jobs.passed(flight):
            return self._jobs.end(flight, None if message.failure else message.seconds)
        try:
            if message.failure:
                self._counters.add("failures")
                self._conduct.failed(flight.worker, flight.object, now)
                return self._fail(flight, f"failed: {message.failure}")
            self._factors.append(self._answers.factor(message, sample.payload, flight))
            seconds = message.seconds
            self._speeds.note(flight.worker, flight.object, now - flight.sent, seconds)
        except Refused as refusal:
            self._conduct.failed(flight.worker, flight.object, now)
            self._fail(flight, f"was refused: {refusal}")
            raise
        finally:
            self._jobs.end(flight, seconds)
        self._counters.add("factors")
        self._counters.add("bytes_in", self._factors[-1].values.nbytes)
        room = flight.factor_slot.capacity if flight.factor_slot is not None else 0
        fits = 0 < self._factors[-1].values.nbytes <= room  # an incomplete one may be larger than all before it
        self._count_bulk("matrix", flight, message.matrix_shared, bool(flight.slots))
        self._count_bulk("factor", flight, message.HasField("slot"), fits)

    def _count_bulk(self, what: str, flight: InFlightJob, shared: bool, lent: bool) -> None:
        self._counters.add("bulk_shared" if shared else "bulk_copied")
        if lent and not shared:
            self._counters.trouble(
                "slots_unused", f"a slot was lent to worker {flight.worker}, but its {what} travelled as bytes"
            )

    def _fail(self, flight: InFlightJob, why: str) -> None:
        self._failures.append((flight.object, f"factorization of {flight.object} at step {flight.step} {why}"))
