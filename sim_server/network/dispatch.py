# SPDX-License-Identifier: MIT
"""Sends matrices to workers and takes in their factors: which worker gets a job, and what becomes of it."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import zenoh

from protocol.channels import CHANNELS, MOST_JOBS, PART_BYTES, WHOLE_PARTS, key, name_in
from protocol.counters import Counters
from protocol.factor import Factor, FactorPattern
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.messages_pb2 import Topology, WorkerInfo
from protocol.method import Method
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot, SlotPool
from protocol.validate import take
from sim_server.network.batch_message import MOST_TOGETHER, Entry, batch_message, entries_of, fill, group
from sim_server.network.factor_decoder import AnnouncedObject, FactorDecoder
from sim_server.network.factor_fetch import AHEAD, FactorFetch
from sim_server.network.inbox import Inbox
from sim_server.network.job_message import add_values, matrix_message
from sim_server.network.leases import MAX_EXPIRED, InFlightJob, Leases
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming
from sim_server.updates.factor_source import FactorSource, Job

log = logging.getLogger(__name__)

TOKEN_QUERY_INTERVAL = 1.0  # s between queries for tokens of workers that send heartbeats without one
FAST_SEND = 0.05  # s in which a fast link takes a job as bytes; zenoh drops what is not taken within 0.25 s
MAX_NEW_PATTERNS = 256  # that wait to be prepared for; older ones are prepared for when their factors come
SMALL_BLOCKS = 20_000  # of the largest matrix, if several jobs may wait at a worker
BEHIND = 10.0  # s of a lease, at most, for what waits at a worker behind a first job, which has a longer one
MOST_ALONE = 32  # jobs in flight at a worker while they go alone, each with slots of its own, which are slow to make
QUEUE_SECONDS = 0.02  # s of factorizations that wait at a worker at most
LOOK_PERIOD = 1e-3  # s between looks at which leases are over
MAX_SENT = 4096  # times of jobs that are remembered
LARGE = 4 << 20  # bytes of a factor whose copy and checks take more than a few milliseconds
SLOT_SHARE = 4  # a larger part of all shared memory than a SLOT_SHARE-th is not lent for one factor: it goes in parts
FETCHES = 2  # factors that arrive in parts at a time, each in memory of its own
SLOT_MARGIN = 8  # the slot for an incomplete factor is larger than the largest factor so far by a SLOT_MARGIN-th


@dataclass
class Filling:
    """Slots of a batch that the thread of the send queue fills and sends; `over` once it has."""

    slots: tuple[Slot, Slot]
    over: bool = False


class Decoding(NamedTuple):
    """A factor that is taken in beside the caller.

    future: that is over once it is done, and `take` returns the factor, or raises Refused
    seconds, by_slot, duration: as of Dispatch._take_factor
    fetch: of its parts, if it comes in parts
    """

    job: InFlightJob
    future: Future[Any]
    take: Callable[[], Factor]
    seconds: float
    by_slot: tuple[bool, bool]
    duration: float | None = None
    fetch: FactorFetch | None = None


class Dispatch(FactorSource):
    """The remote workers of a server as a source of factors.

    Methods may be called from any thread; none waits for the network.

    silence: seconds without a heartbeat until a worker gets no more jobs
    clock: monotonic time [s]
    """

    def __init__(
        self,
        session: zenoh.Session,
        server: str,
        incarnation: int,
        pool: SlotPool | None,
        queue: SendQueue,
        counters: Counters,
        silence: float,
        clock: Callable[[], float],
    ):
        self._session, self._server, self._incarnation = session, server, incarnation
        self._pool, self._queue, self._counters, self._clock = pool, queue, counters, clock
        self.decoder = FactorDecoder(incarnation)
        self._registry = WorkerRegistry(incarnation, silence)
        self.leases = Leases(pool)
        self._timing = WorkerTiming()
        self.reliability = WorkerReliability()
        self._lock = threading.RLock()  # a status lists the workers while the loop thread takes in a factor
        self._last_worker: dict[str, str] = {}  # by object: the worker that knows its pattern already
        self._free_since: dict[str, float] = {}  # by worker, time of its last answer
        self._sent: dict[int, float] = {}  # when the network took a job, by its number
        self._answered_at: dict[str, float] = {}  # likewise, of the answers with a factor
        self._fast_links: set[str] = set()  # workers without shared memory whose link takes a job at once
        self._thread = ThreadPoolExecutor(1, "large factors")
        self._fetching = ThreadPoolExecutor(FETCHES, "parts of factors")
        self.decoding: dict[int, Decoding] = {}  # by number of the job
        self._filling: deque[Filling] = deque()  # oldest first
        self._fetches: set[int] = set()  # of these, the jobs whose factors come in parts
        self._factors: list[Factor] = []
        self._failures: list[tuple[str, str]] = []
        self._patterns: list[tuple[str, FactorPattern]] = []
        self._inbox = Inbox(session, server)
        self._token_query_due = 0.0
        self._looked_at = -LOOK_PERIOD  # at which leases were looked through
        self._on_message: dict[str, Callable[[zenoh.Sample], None]] = {
            "worker": self._on_heartbeat,
            "pattern": self._on_pattern,
            "factor": self._on_factor,
            "factors": self._on_factors,
            "alive_worker": self._on_token,
        }

    def announce(self, topology: Topology) -> None:
        """Begins a new epoch of an object; answers to jobs of the last one are refused."""
        with self._lock:
            if (job := self.leases.by_object.get(topology.header.object)) is not None:
                self._fail(job, "was of a mesh that was split since")
            self.decoder.announce(topology)
            self.leases.forget_object(topology.header.object)
            self._timing.forget_object(topology.header.object)
            self.reliability.forget_object(topology.header.object)

    def epoch(self, name: str) -> int | None:
        """Returns the epoch of an object that was announced last; jobs of others are refused."""
        with self._lock:
            known = self.decoder.objects.get(name)
            return None if known is None else known.epoch

    def workers(self) -> list[WorkerInfo]:
        """Returns the last heartbeats of the workers that may be given jobs."""
        with self._lock:
            self._receive()
            infos = (self._registry.info(name) for name in self._available())
            return [info for info in infos if info is not None]

    def unclaimed_tokens(self) -> int:
        """Number of tokens of workers that have sent no heartbeat. A probe for tests."""
        with self._lock:
            return self._registry.unclaimed_tokens

    def ready(self) -> int:
        """Number of jobs that workers can take now: one of each idle worker, more where all objects are small."""
        with self._lock:
            self._receive()
            return sum(self._room(name) for name in self._open())

    def poll(self) -> list[Factor]:
        """Returns the factors that arrived and passed all checks since the last call."""
        with self._lock:
            self._receive()
            factors, self._factors = self._factors, []
            return factors

    def patterns(self) -> list[tuple[str, FactorPattern]]:
        """Returns (object, pattern) of the patterns that came since the last call; each comes before its factors."""
        with self._lock:
            self._receive()
            patterns, self._patterns = self._patterns, []
            return patterns

    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of the jobs that failed, were refused, expired or were lost since the last call."""
        with self._lock:
            failures, self._failures = self._failures, []
            return failures

    def worker_count(self) -> int:
        """Number of workers that may be given jobs, idle or busy."""
        return len(self.workers())

    def queues_jobs(self) -> bool:
        """True if there are workers and all of them have several jobs at a time."""
        with self._lock:
            available = self._available()
            return bool(available) and all(self._most_waiting(name) > 1 for name in available)

    def assembles_matrices(self) -> bool:
        """True if there are workers and all of them can assemble matrices from positions."""
        infos = self.workers()
        return bool(infos) and all(info.builds for info in infos)

    def faster_busy_workers(self) -> int:
        """Number of busy workers that would finish one more job before the fastest idle one could."""
        with self._lock:
            now = self._clock()
            idle = [(name, now - self._free_since.get(name, 0.0)) for name in self._open()]
            if len(idle) == len(self._available()):
                return 0
            full = {name for name in self.leases.by_worker if not self._room(name)}
            busy = [(j.worker, j.object, now - j.sent_at) for j in self.leases.jobs if j.worker in full]
            return self._timing.faster_busy_workers(idle, busy)

    def reassigned(self) -> list[str]:
        """Objects whose job was taken from a slow worker since another one is idle; they may be submitted again."""
        with self._lock:
            slow = self.leases.reassign(
                self._clock(), lambda job: not self._is_arriving(job) and self._has_candidates(job)
            )
            self._counters.add("passed_on", len(slow))
            return [job.object for job in slow]

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors by the idle ones failed."""
        with self._lock:
            failing = self.reliability.failing_objects
            if not failing:
                return set()
            idle, available = self._open(), self._available()
            return {object for object in failing if idle and not self._candidates(idle, available, object)}

    def consecutive_failures(self) -> dict[str, int]:
        """Jobs in a row that failed at the best worker of each object."""
        with self._lock:
            failing = self.reliability.failing_objects
            available = self._available() if failing else []
            return {object: self.reliability.consecutive_failures(available, object) for object in failing}

    def factor_failed(self, worker: str, object: str) -> None:
        """Notes that a factor made by `worker` was rejected, or that solves had to abandon it."""
        with self._lock:
            self.reliability.on_failure(worker, object, self._clock())

    def factor_helped(self, worker: str, object: str) -> None:
        """Notes that a solve converged with a factor made by `worker`."""
        with self._lock:
            self.reliability.on_success(worker, object)

    # ---- jobs to workers -------------------------------------------------------------------------------------

    def submit(self, job: Job) -> bool:
        """Sends a job to a worker with room; False if there is none or the object has a job in flight."""
        with self._lock:
            self._receive()
            return self._submit(job)

    def submit_many(self, jobs: Sequence[Job]) -> list[bool]:
        """Sends jobs of different objects, the most urgent first, those of small objects to one worker in one message.

        False for those for which no worker has room, or whose object has a job in flight. Matrices are read until their
        jobs are over: what is sent of one that changes before is of a job that nobody waits for.
        """
        with self._lock:
            self._receive()
            return self._submit_many(jobs)

    def _submit_many(self, jobs: Sequence[Job]) -> list[bool]:
        taken = [False] * len(jobs)
        batches: dict[tuple[str, tuple[str, Method]], list[int]] = {}  # places of jobs by worker and what they share
        rooms = {name: self._room(name) for name in self._open()} if len(jobs) > 1 else {}
        able = {name for name in rooms if self._takes_batches(name)}
        for place, job in enumerate(jobs):
            idle = [name for name, room in rooms.items() if room > 0]
            worker = self._worker_for(job, idle, rooms) if idle else None
            if worker is None or worker not in able or not self._fits_batch(job):
                taken[place] = self._submit(job)
                rooms = {name: self._room(name) for name in self._open()}
                for (name, _), places in batches.items():
                    rooms[name] = rooms.get(name, 0) - len(places)
            else:
                rooms[worker] -= 1
                batches.setdefault((worker, group(job)), []).append(place)
        for (worker, _), places in batches.items():
            for k in range(0, len(places), MOST_TOGETHER):
                part = places[k : k + MOST_TOGETHER]
                for place, sent in zip(part, self._send_batch(worker, [jobs[p] for p in part]), strict=True):
                    taken[place] = sent
        return taken

    def _worker_for(self, job: Job, idle: list[str], rooms: Mapping[str, int]) -> str | None:
        """Chooses a worker of those with room; None if there is none or the object has a job in flight."""
        self._check_job(job)
        if job.object in self.leases.by_object:
            return None
        able = [name for name in idle if not job.positions or self._assembles(name)]
        if self.reliability.failing_objects:
            able = self._candidates(able, self._available(), job.object)
        return self._choose(able, job.object, rooms) if able else None

    def _fits_batch(self, job: Job) -> bool:
        """True if the size of the factor is known: that of an incomplete one may grow."""
        sized = self.decoder.objects[job.object].most_values(job.method.name) > 0
        return not job.positions and sized and job.method.name != "incomplete_cholesky"

    def _takes_batches(self, worker: str) -> bool:
        """True if several jobs of a worker may share a message. It has room for several only where all objects are
        small."""
        info = self._registry.info(worker)
        return info is not None and info.batches and self._room(worker) > 1 and self._has_slots(worker)

    def _send_batch(self, worker: str, jobs: Sequence[Job]) -> list[bool]:
        """Sends jobs to a worker in one message, or one by one if there are no slots for them together."""
        slots = None
        if len(jobs) > 1:
            entries = entries_of([(job, self.decoder.objects[job.object]) for job in jobs])
            slots = self._allocate_batch(entries)
        if slots is None:
            return [self._submit_to(worker, job) for job in jobs]
        leases = [self.leases.lease(job.object, worker, job.method.name) for job in jobs]
        in_flight = [
            self._begin_job(job, worker, lease, slots, factor_slot=slots[1], first=entry.first, room=entry.room)
            for job, lease, entry in zip(jobs, leases, entries, strict=True)
        ]
        message = batch_message(entries, in_flight, leases, self._incarnation, *slots)
        name, matrices, filling = (
            key("matrices", self._server, worker=worker),
            [job.values for job in jobs],
            Filling(slots),
        )

        def send() -> None:
            try:
                fill(message, matrices, slots[0])
                self._send(in_flight, name, slots[0].payload, message.SerializeToString(), True)
            finally:
                filling.over = True

        if self._queue.post(send):
            self._filling.append(filling)
            self._on_sent(worker, jobs)
            return [True] * len(jobs)
        for job in in_flight:
            self.leases.cancel(job)
        self._give_back(slots)
        return [False] * len(jobs)

    def _allocate_batch(self, entries: Sequence[Entry]) -> tuple[Slot, Slot] | None:
        """Allocates a slot for matrices and one for factors; None if there is not enough shared memory."""
        assert self._pool is not None
        users = len(entries) + 1  # and the thread that sends them
        matrices = self._pool.lend(sum(entry.job.values.nbytes for entry in entries), users)
        factors = self._pool.lend(entries[-1].first + entries[-1].room, users)
        if matrices is not None and factors is not None:
            return matrices, factors
        for slot in filter(None, (matrices, factors)):
            for _ in range(users):
                self._pool.give_back(slot)
        return None

    def _on_sent(self, worker: str, jobs: Sequence[Job]) -> None:
        for job in jobs:
            self._last_worker[job.object] = worker
        self.reliability.on_sent(worker, self._clock())
        self._counters.add("jobs", len(jobs))
        self._counters.add("bytes_out", sum(job.values.nbytes for job in jobs))

    def _check_job(self, job: Job) -> AnnouncedObject:
        known = self.decoder.objects.get(job.object)
        if known is None or known.epoch != job.epoch:
            raise ValueError(f"job for {job.object} epoch {job.epoch}, which was not announced")
        shape = (known.size // 3, 3) if job.positions else (known.blocks, 3, 3)
        if job.values.shape != shape or job.values.dtype != np.float64:
            raise ValueError(f"job for {job.object}: values {job.values.shape}, allowed: float64 {shape}")
        return known

    def _submit(self, job: Job) -> bool:
        self._check_job(job)
        idle = [name for name in self._open() if not job.positions or self._assembles(name)]
        idle = self._candidates(idle, self._available(), job.object)
        if job.object in self.leases.by_object or not idle:
            return False
        return self._submit_to(self._choose(idle, job.object), job)

    def _submit_to(self, worker: str, job: Job) -> bool:
        """Sends a job alone."""
        matrix_slot, factor_slot = self._allocate_slots(worker, job)
        lease = self.leases.lease(
            job.object, worker, job.method.name, job.positions, self.decoder.objects[job.object].blocks
        )
        slots = tuple(slot for slot in (matrix_slot, factor_slot) if slot is not None)
        payload_bytes = 0 if matrix_slot else job.values.nbytes
        in_flight = self._begin_job(job, worker, lease, slots, factor_slot=factor_slot, payload_bytes=payload_bytes)
        if self._post(in_flight, job, lease, matrix_slot):
            self._on_sent(worker, [job])
            return True
        self.leases.cancel(in_flight)
        return False

    def _begin_job(
        self, job: Job, worker: str, lease: float, slots: tuple[Slot, ...], factor_slot: Slot | None, **more: int
    ) -> InFlightJob:
        """Begins the lease of a job that is being sent. more: fields of InFlightJob"""
        now = self._clock()
        in_flight = InFlightJob(
            self.leases.next_number(),
            job.object,
            job.epoch,
            job.step,
            job.warp,
            _dtype_name(job.dtype),
            worker,
            deadline=now + max(lease, min(self.leases.deadlines().get(worker, 0.0) - now, BEHIND)),
            factor_slot=factor_slot,
            factor_generation=factor_slot.generation if factor_slot else 0,
            slots=slots,
            sent_at=now,
            exclusive_until=now + self.leases.exclusive_period(job.object, self.decoder.objects[job.object].blocks),
            method=job.method.name,
            positions=job.positions,
            part_bytes=PART_BYTES,
            **more,
        )
        self.leases.start(in_flight)
        return in_flight

    def _available(self) -> list[str]:
        return self._registry.available(self._clock(), self.leases.deadlines())

    def _open(self) -> list[str]:
        """Available workers with room for a job."""
        available, now = self._available(), self._clock()
        free = [name for name in available if self._room(name) > 0]
        return [name for name in free if self.reliability.may_get_job(name, available, now)]

    def _room(self, worker: str) -> int:
        """Number of jobs that a worker can take beside those it has.

        Several wait at a worker only where all objects are small and arrays are in shared memory, as many as it does
        within QUEUE_SECONDS: it then need not wait for the network after each, and may factorize them together.
        """
        return max(0, self._most_waiting(worker) - self._waiting(worker))

    def _most_waiting(self, worker: str) -> int:
        """Number of jobs that may be in flight at a worker."""
        info, seconds = self._registry.info(worker), self._timing.mean_factorization(worker)
        most = 1
        small = self.decoder.most_blocks <= SMALL_BLOCKS and self._pool is not None
        if info is not None and info.shared_memory and seconds is not None and small:
            most = MOST_JOBS if info.batches and self.decoder.most_are_sized else MOST_ALONE
            most = max(1, min(info.most_jobs, most, int(QUEUE_SECONDS / max(seconds, 1e-6))))
        return most

    def _waiting(self, worker: str) -> int:
        """Number of jobs that a worker has not done yet; those whose parts are fetched are done."""
        fetched = sum(self.decoding[number].job.worker == worker for number in self._fetches)
        return self.leases.count(worker) - fetched

    def _candidates(self, idle: list[str], available: list[str], object: str) -> list[str]:
        """Idle workers that are not suspended for the object; all idle ones if all available workers are."""
        now = self._clock()
        good = [name for name in available if not self.reliability.is_suspended(name, object, now)]
        return [name for name in idle if name in good] if good else idle

    def _has_candidates(self, job: InFlightJob) -> bool:
        """True if another worker could take the object of a job in flight."""
        others = [name for name in self._open() if name != job.worker]
        return bool(self._candidates(others, self._available(), job.object)) if others else False

    def _assembles(self, worker: str) -> bool:
        info = self._registry.info(worker)
        return info is not None and info.builds

    def _choose(self, idle: list[str], object: str, rooms: Mapping[str, int] | None = None) -> str:
        """Chooses the worker with the fewest expired jobs; then the one that would be done first, the one with the
        fewest jobs in flight, the last of the object, the least used.

        rooms: jobs that workers can take besides those that are about to be sent; None: none is
        """
        if len(idle) == 1:
            return idle[0]

        def rank(name: str) -> tuple[int, float, int, bool, int]:
            info, waiting = self._registry.info(name), self._waiting(name)
            waiting += 0 if rooms is None else self._room(name) - rooms[name]
            expired, expected = self.leases.expired_count(name), self._timing.expected(name, object)
            other = self._last_worker.get(object) != name
            return expired, (1 + waiting) * expected, waiting, other, info.jobs if info else 0

        return min(idle, key=rank)

    def _allocate_slots(self, worker: str, job: Job) -> tuple[Slot | None, Slot | None]:
        """Allocates slots for the matrix and its factor; None for an array that must travel as bytes."""
        if self._pool is None or not self._has_slots(worker):
            return None, None
        nonzeros = self.decoder.objects[job.object].most_values(job.method.name)
        if job.method.name == "incomplete_cholesky":
            nonzeros += nonzeros // SLOT_MARGIN  # the next factor may keep more blocks
        size = nonzeros * np.dtype(job.dtype).itemsize
        if size > max(WHOLE_PARTS * PART_BYTES, self._pool.limit // SLOT_SHARE):
            size = 0  # it comes in parts
        matrix = self._pool.lend(job.values.nbytes)
        factor = self._pool.lend(size) if size else None
        if matrix is None or (size and factor is None):
            self._counters.trouble("slots_exhausted", "no slot of shared memory is left, an array travels as bytes")
        return matrix, factor

    def _has_slots(self, worker: str) -> bool:
        """True if arrays may travel to and from a worker in slots of shared memory."""
        info = self._registry.info(worker)
        unfit = info is None or not info.shared_memory or self.leases.expired_count(worker) >= MAX_EXPIRED
        return self._pool is not None and not unfit

    def _post(self, in_flight: InFlightJob, job: Job, lease: float, slot: Slot | None) -> bool:
        known = self.decoder.objects[job.object]
        message = matrix_message(in_flight, known, self._incarnation, lease, job.method)
        payload = add_values(message, job.values, slot)
        name = key("matrix", self._server, worker=in_flight.worker, object=in_flight.object)
        attachment = message.SerializeToString()
        return self._queue.post(lambda: self._send([in_flight], name, payload, attachment, slot is not None))

    def _send(
        self, jobs: Sequence[InFlightJob], name: str, payload: zenoh.ZBytes, attachment: bytes, shared: bool
    ) -> None:  # fmt: skip
        """Sends a job or a batch of them, in the thread of the send queue. If a link is full, zenoh drops it or blocks.

        A dropped job ends its lease. zenoh blocks only for bytes over a link that is not known to be fast, since a
        slow link takes longer than zenoh would keep them. While it blocks for one receiver all others wait too, even
        for a receiver that subscribed to everything and stopped reading. The priority is one of its own, since a
        blocked message locks the queue of its priority.
        """
        worker = jobs[0].worker
        drop = shared or worker in self._fast_links
        control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
        begin = time.perf_counter()
        self._session.put(
            name, payload, attachment=attachment, congestion_control=control, priority=zenoh.Priority.BACKGROUND
        )
        if not drop and time.perf_counter() - begin < FAST_SEND:
            self._fast_links.add(worker)
        for job in jobs:
            self._sent[job.number] = self._clock()

    # ---- messages from workers -------------------------------------------------------------------------------

    def _receive(self) -> None:
        """Takes in all messages that arrived, refuses malformed ones, and ends leases."""
        for channel, sample in self._inbox:
            try:
                self._on_message[channel](sample)
            except Refused as refusal:
                self._counters.refuse(refusal)
        self._take_decoded()
        while self._filling and self._filling[0].over:
            self._give_back(self._filling.popleft().slots)
        self._query_tokens()
        now = self._clock()
        if now < self._looked_at + LOOK_PERIOD:
            return  # many jobs are submitted one after another
        self._looked_at = now
        if len(self._sent) > MAX_SENT:
            flying = {job.number for job in self.leases.jobs}
            self._sent = {number: when for number, when in self._sent.items() if number in flying}
        for job in self.leases.expire(now, self._is_decoded):
            self._counters.add("leases_over")
            self._on_expired(job, "was not answered within its lease")
        for job in self.leases.expire_undelivered(self._sent_at, self._registry.idle_period):
            self._counters.add("jobs_lost")
            self._on_expired(job, f"was lost: worker {job.worker} says that it has no job")

    def _sent_at(self, job: InFlightJob) -> float:
        return float("inf") if job.number in self.decoding else self._sent.get(job.number, float("inf"))

    def _on_expired(self, job: InFlightJob, why: str) -> None:
        self._fast_links.discard(job.worker)  # zenoh may have dropped the job
        self.reliability.on_failure(job.worker, job.object, self._clock())
        self._fail(job, why)

    def _query_tokens(self) -> None:
        """Queries the tokens of workers that send heartbeats without one, at most once per TOKEN_QUERY_INTERVAL."""
        now = self._clock()
        if now >= self._token_query_due:
            self._token_query_due = now + TOKEN_QUERY_INTERVAL
            if wanted := self._registry.without_token(now):
                self._inbox.query_tokens(wanted)

    def _on_token(self, sample: zenoh.Sample) -> None:
        name = name_in("alive_worker", sample.key_expr, "worker")
        if self._registry.set_token(name, sample.kind == zenoh.SampleKind.PUT):
            self._remove_worker(name)

    def _on_heartbeat(self, sample: zenoh.Sample) -> None:
        data = take(sample.payload, CHANNELS["worker"].limit, "WorkerInfo")
        name, new, removed = self._registry.heartbeat(sample.key_expr, data, self._clock(), self.leases.deadlines())
        if removed:
            self._remove_worker(removed)
        if new:
            self._remove_worker(name)  # the jobs of an earlier process of this name are lost
            info = self._registry.info(name)
            log.info("worker %s joined: %s", name, info.library if info else "")
            if info and self._pool is not None and not info.shared_memory:
                self._counters.warn("worker_copies", f"worker {name} has no shared memory with us, arrays are copied")

    def _remove_worker(self, name: str) -> None:
        lost = self.leases.remove_worker(name)
        self._timing.forget_worker(name)
        self.reliability.forget_worker(name)
        self._fast_links.discard(name)
        self._free_since.pop(name, None)
        self._answered_at.pop(name, None)
        for job in lost:
            self._counters.add("jobs_lost")
            self._fail(job, f"was lost with worker {name}")

    def _on_pattern(self, sample: zenoh.Sample) -> None:
        if (new := self.decoder.add_pattern(sample.key_expr, sample.payload)) is not None:
            self._patterns = [*self._patterns, new][-MAX_NEW_PATTERNS:]

    def _on_factor(self, sample: zenoh.Sample) -> None:
        message = self.decoder.parse_factor(sample.key_expr, sample.attachment)
        job = self.leases.match_answer(message.job, message.worker, message.header.epoch)
        now = self._clock()
        self._registry.mark_seen(job.worker, now)
        self._free_since[job.worker] = now
        self.reliability.on_answer(job.worker)
        if self.leases.is_reassigned(job):
            return self.leases.finish(job, None if message.failure else message.seconds)
        if message.parts and not message.failure:
            return self._fetch(message, job)
        decode = partial(self.decoder.decode, message, sample.payload, job)
        if not message.failure and 4 * message.nonzeros > LARGE:  # its bytes are copied and checked beside the caller
            self._refuse_second(job)
            future = self._thread.submit(decode)
            made = Decoding(job, future, future.result, message.seconds, _slots_used(message))
            self.decoding[job.number] = made
            return
        self._take_factor(job, decode, message.failure, message.seconds, _slots_used(message))

    def _on_factors(self, sample: zenoh.Sample) -> None:
        """Takes answers to jobs of a batch, each by itself: what is wrong with one costs the others nothing."""
        message = self.decoder.parse_batch(sample.key_expr, sample.attachment)
        now, worker = self._clock(), message.worker
        self._registry.mark_seen(worker, now)
        duration, large = 0.0, 4 * sum(message.nonzeros) > LARGE
        beside: dict[int, tuple[int, InFlightJob]] = {}  # by number; large all together: decoded beside the caller
        for place, number in enumerate(message.jobs):
            try:
                job = self.leases.match_answer(number, worker, None)
                if not duration:
                    duration = self._duration(job, now) / len(message.jobs)
                    self._free_since[worker] = now
                    self.reliability.on_answer(worker)
                if self.leases.is_reassigned(job):
                    self.leases.finish(job)
                elif failure := message.failures[place] if message.failures else "":
                    self._take_factor(job, _no_factor, failure, 0.0, (True, True))
                elif not large:
                    decode, told = partial(self.decoder.decode_one, message, place, job), message.seconds[place]
                    self._take_factor(job, decode, "", told, (message.matrix_shared, True), duration)
                elif number in self.decoding or number in beside:
                    raise Refused(f"FactorBatch.jobs has {number}, already answered", "duplicate")
                else:
                    beside[number] = place, job
            except Refused as refusal:
                self._counters.refuse(refusal)
        if beside:
            future = self._thread.submit(self.decoder.decode_several, message, list(beside.values()))
            for k, (place, job) in enumerate(beside.values()):
                take, by_slot = partial(_result, future, k), (message.matrix_shared, True)
                self.decoding[job.number] = Decoding(job, future, take, message.seconds[place], by_slot, duration)

    def _fetch(self, message: FactorMessage, job: InFlightJob) -> None:
        """Begins to fetch a factor in parts, beside the caller. Its worker is free for the jobs of other objects."""
        self._refuse_second(job)
        info, slots = self._registry.info(job.worker), []
        if self._pool is not None and info is not None and info.shared_memory:
            slots = [slot for slot in (self._pool.lend(job.part_bytes) for _ in range(AHEAD)) if slot is not None]
            if len(slots) < AHEAD:
                self._give_back(slots)
                slots = []
        fetch = FactorFetch(
            self._session, self._server, self._incarnation, self._counters, job, message.nonzeros, message.parts, slots
        )
        decode = partial(self.decoder.decode, message, b"", job, fetch.run)
        future, by_slot = self._fetching.submit(decode), _slots_used(message, fetch)
        made = Decoding(job, future, future.result, message.seconds, by_slot, fetch=fetch)
        self.decoding[job.number] = made
        self._fetches.add(job.number)

    def _give_back(self, slots: Sequence[Slot], clean: bool = True) -> None:
        """Frees the slots of a fetch. clean: nobody writes to them any more."""
        if self._pool is not None:
            for slot in slots:
                (self._pool.give_back if clean else self._pool.discard)(slot)

    def _refuse_second(self, job: InFlightJob) -> None:
        if self._is_decoded(job):
            raise Refused(f"Factor.job is {job.number}, already answered", "duplicate")

    def _is_decoded(self, job: InFlightJob) -> bool:
        """True while the answer to a job is taken in beside the caller."""
        return job.number in self.decoding

    def _is_arriving(self, job: InFlightJob) -> bool:
        """True while the answer to a job is taken in, unless it comes in parts and none comes any more."""
        each = self.decoding.get(job.number)
        return each is not None and not (each.fetch is not None and each.fetch.stalls)

    def _take_decoded(self) -> None:
        """Takes the large factors that were decoded beside the caller, unless their jobs are over."""
        for number in self._fetches:
            job, fetch = self.decoding[number].job, self.decoding[number].fetch
            if fetch is not None and self.leases.by_object.get(job.object) is not job:
                fetch.give_up()
        done = {id(future) for future in {each.future for each in self.decoding.values()} if future.done()}
        for number in [number for number, each in self.decoding.items() if id(each.future) in done]:
            each = self.decoding.pop(number)
            self._fetches.discard(number)
            job, fetch = each.job, each.fetch
            if fetch is not None:
                self._give_back(fetch.slots, fetch.clean)
                if fetch.gone.is_set():  # why its job is over was told
                    self._end_gone(job)
                    continue
            try:
                current = self.leases.match_answer(job.number, job.worker, job.epoch)
                if self.leases.is_reassigned(current):
                    self.leases.finish(current)
                else:
                    by_slot = each.by_slot if fetch is None else (each.by_slot[0], bool(fetch.slots))
                    self._take_factor(current, each.take, "", each.seconds, by_slot, each.duration)
            except Refused as refusal:
                self._counters.refuse(refusal)

    def _end_gone(self, job: InFlightJob) -> None:
        """Frees the worker of a job that is over, if it is still there."""
        if self.leases.by_worker.get(job.worker, {}).get(job.number) is job:
            if self.leases.is_reassigned(job):  # its parts did not come
                self.reliability.on_failure(job.worker, job.object, self._clock())
            self.leases.finish(job)

    def _take_factor(
        self, job: InFlightJob, decode: Callable[[], Factor], failure: str, told: float, by_slot: tuple[bool, bool],
        duration: float | None = None,
    ) -> None:  # fmt: skip
        """Takes the answer to a job: the factor that `decode` returns, or a failure.

        told: time [s] of the factorization, by the worker
        by_slot: matrix and factor travelled in shared memory
        duration: from matrix to factor [s]; None: until now
        """
        now, seconds = self._clock(), None
        try:
            if failure:
                self._counters.add("failures")
                self.reliability.on_failure(job.worker, job.object, now)
                return self._fail(job, f"failed: {failure[:500]}")
            self._factors.append(decode())
            seconds = told
            lasted = self._duration(job, now) if duration is None else duration
            self._timing.record(job.worker, job.object, lasted, seconds)
        except Refused as refusal:
            self.reliability.on_failure(job.worker, job.object, now)
            self._fail(job, f"was refused: {refusal}")
            raise
        finally:
            self.leases.finish(job, seconds)
        self._counters.add("factors")
        self._counters.add("bytes_in", self._factors[-1].values.nbytes)
        capacity = job.factor_slot.capacity if job.factor_slot is not None else 0
        fits = 0 < self._factors[-1].values.nbytes <= capacity  # an incomplete factor may be the largest so far
        self._count_bulk("matrix", job, by_slot[0], bool(job.slots))
        self._count_bulk("factor", job, by_slot[1], fits)

    def _duration(self, job: InFlightJob, now: float) -> float:
        """Time [s] from matrix to factor, without that for which the job waited behind others of its worker."""
        last, self._answered_at[job.worker] = self._answered_at.get(job.worker, 0.0), now
        return now - max(job.sent_at, last)

    def _count_bulk(self, what: str, job: InFlightJob, shared: bool, allocated: bool) -> None:
        self._counters.add("bulk_shared" if shared else "bulk_copied")
        if allocated and not shared:
            self._counters.trouble(
                "slots_unused", f"a slot was lent to worker {job.worker}, but its {what} travelled as bytes"
            )

    def _fail(self, job: InFlightJob, why: str) -> None:
        self._failures.append((job.object, f"factorization of {job.object} at step {job.step} {why}"))


@cache
def _dtype_name(dtype: str) -> str:
    return np.dtype(dtype).name


def _no_factor() -> Factor:
    """Raises Refused: the worker has told why there is none."""
    raise Refused("there is no factor", "malformed")


def _result(future: Future[list[Factor | Refused]], place: int) -> Factor:
    """Returns one of several factors that were decoded together; raises Refused."""
    found = future.result()[place]
    if isinstance(found, Refused):
        raise found
    return found


def _slots_used(message: FactorMessage, fetch: FactorFetch | None = None) -> tuple[bool, bool]:
    """Whether matrix and factor travelled in shared memory. fetch: of its parts"""
    return message.matrix_shared, message.HasField("slot") or (fetch is not None and bool(fetch.slots))
