# SPDX-License-Identifier: MIT
"""Sends matrices to workers and takes in their factors.

Who gets a job is decided in worker_choice.py, how it travels in job_sender.py, what becomes of the answer in
factor_intake.py; all of them share what is known of workers and jobs (bookkeeping.py).
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import zenoh

from protocol.channels import CHANNELS, name_in
from protocol.counters import Counters
from protocol.factor import Factor, FactorPattern
from protocol.messages_pb2 import Topology, WorkerInfo
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot, SlotPool
from protocol.validate import take
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.device_slots import DeviceSlot, DeviceSlots
from sim_server.network.factor_decoder import FactorDecoder
from sim_server.network.factor_intake import FactorIntake
from sim_server.network.inbox import Inbox
from sim_server.network.job_sender import JobSender
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.network.leases import Leases
from sim_server.network.native_copies import compile_ahead
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_choice import WorkerChoice
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming
from sim_server.updates.factor_source import FactorMemory, FactorSource, Job
from sim_server.updates.take_in import BeginCheck

log = logging.getLogger(__name__)

TOKEN_QUERY_INTERVAL = 1.0  # s between queries for tokens of workers that send heartbeats without one
MAX_NEW_PATTERNS = 256  # that wait to be prepared for; older ones are prepared for when their factors come
LOOK_PERIOD = 1e-3  # s between looks at which leases are over
PARTING = 0.05  # s for which jobs of a worker that left are kept: its last answers may be in the hands of a thread


class Dispatch(FactorSource):
    """The remote workers of a server as a source of factors.

    Methods may be called from any thread; none waits for the network.

    silence: seconds without a heartbeat until a worker gets no more jobs
    clock: monotonic time [s]

    device: device memory for matrices and factors; None: there is none
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
        compile_ahead()
        self._counters, self._pool, self._shared, self._clock = counters, pool, pool is not None, clock
        self.device: DeviceSlots | None = None
        self.decoder, self.leases, self.reliability = FactorDecoder(incarnation), Leases(self), WorkerReliability()
        self._registry = WorkerRegistry(incarnation, silence)
        self._book = Bookkeeping(
            self._registry, self.leases, WorkerTiming(), self.reliability, self.decoder, clock
        )  # fmt: skip
        self._intake = FactorIntake(session, server, incarnation, pool, counters, self._book)
        self._choice = WorkerChoice(self._book, self._shared, self._intake.fetched_from)
        self._sender = JobSender(session, server, incarnation, pool, queue, counters, self._book, self._choice)
        self._lock = threading.RLock()  # a status lists the workers while the loop thread takes in a factor
        self._patterns: list[tuple[str, FactorPattern]] = []
        self._inbox = Inbox(session, server)
        self._token_query_due = 0.0
        self._looked_at = -LOOK_PERIOD  # at which leases were looked through
        self._parting: dict[str, float] = {}  # workers that left with jobs in flight: until when these are kept [s]
        self._received = False  # within a round whose messages were taken in
        self._known_rooms: dict[str, int] | None = None  # in such a round
        self._on_message: dict[str, Callable[[zenoh.Sample], None]] = {
            "worker": self._on_heartbeat,
            "pattern": self._on_pattern,
            "factor": self._intake.on_factor,
            "alive_worker": self._on_token,
        }

    @property
    def decoding(self) -> int:
        """Number of factors that are taken in beside the caller. A probe for tests."""
        return self._intake.decoded

    def take_in_batches(self) -> None:
        """Takes in messages of several factors, beside the caller of all else, until the session is closed."""
        self._intake.batches.run()

    def wake_by(self, wake: Callable[[], None]) -> None:
        """Has `wake` called, in another thread, when a factor that is taken in beside the caller is there."""
        self._intake.wake_by(wake)

    def makes_slots(self) -> bool:
        """True while shared memory for arrays is being made beside the caller."""
        with self._lock:
            return any(slots is not None and slots.makes_any for slots in (self._pool, self.device))

    def announce(self, topology: Topology) -> None:
        """Begins a new epoch of an object; answers to jobs of the last one are refused."""
        with self._lock:
            self._book.announce(topology)
            if self._pool is not None:
                self._pool.prepare(72 * len(topology.columns) // 4)  # of the matrix, 3x3 numbers of 8 bytes a block

    def share_device(self, device: DeviceSlots) -> None:
        """Has matrices and factors of workers that can open it stay in device memory."""
        with self._lock:
            self.device = self._sender.device = device
            self.decoder.device = device.memory

    def give_back(self, slot: Slot | DeviceSlot, users: int = 1) -> None:
        """Frees a slot of so many jobs that are over."""
        pool: Any = self.device if isinstance(slot, DeviceSlot) else self._pool
        if pool is not None:
            pool.give_back(slot, users)

    def epoch(self, name: str) -> int | None:
        """Returns the epoch of an object that was announced last; jobs of others are refused."""
        known = self.decoder.objects.get(name)  # without the lock: it is asked of each factor
        return None if known is None else known.epoch

    def workers(self) -> list[WorkerInfo]:
        """Returns the last heartbeats of the workers that may be given jobs."""
        with self._lock:
            self._receive()
            infos = (self._registry.info(name) for name in self._book.available())
            return [info for info in infos if info is not None]

    def worker_info(self, name: str) -> WorkerInfo | None:
        """Returns the last heartbeat of a worker; None if it has left."""
        with self._lock:
            return self._registry.info(name)

    def unclaimed_tokens(self) -> int:
        """Number of tokens of workers that have sent no heartbeat. A probe for tests."""
        with self._lock:
            return self._registry.unclaimed_tokens

    @contextmanager
    def round(self) -> Iterator[None]:
        """Takes in all messages that arrived at the begin of a round of calls, and no more within it."""
        with self._lock:
            self._receive()
            self._received, self._known_rooms = True, None
        try:
            yield
        finally:
            self._received = False

    def ready(self) -> int:
        """Number of jobs that workers can take now: one of each idle worker, more where all objects are small."""
        with self._lock:
            self._receive()
            return sum(self._rooms().values())

    def _rooms(self) -> dict[str, int]:
        """Returns the rooms of workers; within a round they are those of the last call, if nothing was sent since."""
        if self._known_rooms is None or not self._received:
            self._known_rooms = self._choice.rooms()
        return self._known_rooms

    def submit(self, job: Job) -> bool:
        """Sends a job to a worker with room; False if there is none or the object has a job in flight."""
        with self._lock:
            self._receive()
            self._known_rooms = None
            return self._sender.submit(job)

    def submit_many(self, jobs: Sequence[Job]) -> list[bool]:
        """Sends jobs of different objects, the most urgent first, those of small objects to one worker in one message.

        False for those for which no worker has room, or whose object has a job in flight. Matrices are read until their
        jobs are over: what is sent of one that changes before is of a job that nobody waits for.
        """
        with self._lock:
            self._receive()
            rooms, self._known_rooms = self._rooms(), None
            return self._sender.submit_many(jobs, rooms)

    def poll(self) -> list[Factor]:
        """Returns the factors that arrived and passed all checks since the last call."""
        with self._lock:
            together = self.poll_together()
            return [*self._intake.alone(), *(factor for each in together for factor in each)]

    def poll_together(self) -> list[FactorsTogether]:
        """Returns those of messages of several; the next `poll` returns the others."""
        with self._lock:
            self._receive()
            return self._intake.together()

    def patterns(self) -> list[tuple[str, FactorPattern]]:
        """Returns (object, pattern) of the patterns that came since the last call; each comes before its factors."""
        with self._lock:
            self._receive()
            patterns, self._patterns = self._patterns, []
            return patterns

    def failures(self) -> list[tuple[str, str]]:
        """Returns (object, reason) of the jobs that failed, were refused, expired or were lost since the last call."""
        with self._lock:
            failures, self._book.failures = self._book.failures, []
            return failures

    def use_memory(self, memory: FactorMemory) -> None:
        """Has large factors that arrive put into arrays that `memory` makes."""
        self.decoder.memory = memory

    def check_with(self, begin: BeginCheck) -> None:
        """Has factors of messages checked in the thread that copies them."""
        self._intake.batches.begin_check = begin

    def worker_count(self) -> int:
        """Number of workers that may be given jobs, idle or busy."""
        return len(self.workers())

    def assembles_matrices(self) -> bool:
        """True if there are workers and all of them can assemble matrices from positions."""
        infos = self.workers()
        return bool(infos) and all(info.builds for info in infos)

    def queues_jobs(self) -> bool:
        """True if there are workers and all of them have several jobs at a time."""
        with self._lock:
            available = self._book.available()
            return bool(available) and all(self._choice.most_waiting(name) > 1 for name in available)

    def faster_busy_workers(self) -> int:
        """Number of busy workers that would finish one more job before the fastest idle one could."""
        with self._lock:
            return self._choice.faster_busy_workers()

    def reassigned(self) -> list[str]:
        """Objects whose job was taken from a slow worker since another one is idle; they may be submitted again."""

        def may_move(job: InFlightJob) -> bool:
            return not self._intake.is_arriving(job) and self._choice.may_move(job)

        with self._lock:
            slow = self.leases.reassign(self._clock(), may_move)
            self._counters.add("passed_on", len(slow))
            return [job.object for job in slow]

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors by the idle ones failed."""
        with self._lock:
            return self._choice.reserved()

    def consecutive_failures(self) -> dict[str, int]:
        """Jobs in a row that failed at the best worker of each object."""
        with self._lock:
            return self._choice.consecutive_failures()

    def factor_failed(self, worker: str, object: str, pattern: int | None = None) -> None:
        """Notes that a factor made by `worker` was rejected, or that solves had to abandon it. pattern: its id, if it
        was rejected"""
        with self._lock:
            if pattern is not None:
                self.decoder.on_rejected(object, pattern)
            self.reliability.on_failure(worker, object, self._clock())

    def factor_helped(self, worker: str, object: str) -> None:
        """Notes that a solve converged with a factor made by `worker`."""
        with self._lock:
            self.reliability.on_success(worker, object)

    # ---- messages from workers -------------------------------------------------------------------------------

    def _receive(self) -> None:
        """Takes in all messages that arrived, refuses malformed ones, and ends leases. Once in a `round`."""
        if self._received:
            return
        batches = self._intake.batches.done  # whose patterns came before them, and are read now
        for channel, sample in self._inbox:
            try:
                self._on_message[channel](sample)
            except Refused as refusal:
                self._counters.refuse(refusal)
            except Exception as error:  # whatever a message holds, the run goes on
                self._counters.refuse(self._counters.unexpected(error, f"a message {str(sample.key_expr)[:200]!r}"))
        try:
            self._intake.take_decoded(batches)
        except Exception as error:
            self._counters.refuse(self._counters.unexpected(error, "factors taken in beside the caller"))
        for name in [name for name, due in self._parting.items() if time.monotonic() >= due]:
            self._remove_worker(name)
        self._sender.give_back_sent()
        self._query_tokens()
        if self._clock() >= self._looked_at + LOOK_PERIOD:  # many jobs are submitted one after another
            self._looked_at = self._clock()
            self._end_leases()

    def _end_leases(self) -> None:
        """Ends the leases of jobs that took too long or were lost on the way."""
        if self.leases.over(self._clock(), self._intake.is_decoded):
            self._finish_batches()  # their answers may wait for a thread
        for job in self.leases.expire(self._clock(), self._intake.is_decoded):
            self._counters.add("leases_over")
            self._on_expired(job, "was not answered within its lease")
        for job in self.leases.expire_undelivered(self._put_at, self._registry.idle_period):
            self._counters.add("jobs_lost")
            self._on_expired(job, f"was lost: worker {job.worker} says that it has no job")

    def _finish_batches(self) -> None:
        """Takes all messages of several factors that have come. Whatever they hold, the run goes on."""
        try:
            self._intake.batches.finish()
        except Exception as error:
            self._counters.refuse(self._counters.unexpected(error, "factors of messages"))

    def _put_at(self, job: InFlightJob) -> float:
        return float("inf") if self._intake.is_decoded(job) else job.put_at

    def _on_expired(self, job: InFlightJob, why: str) -> None:
        self._sender.forget_link(job.worker)  # zenoh may have dropped the job
        self.reliability.on_failure(job.worker, job.object, self._clock())
        self._book.fail(job, why)

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
            if self.leases.count(name):
                self._parting[name] = time.monotonic() + PARTING
            else:
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
            if info and self._shared and not info.shared_memory:
                self._counters.warn("worker_copies", f"worker {name} has no shared memory with us, arrays are copied")

    def _remove_worker(self, name: str) -> None:
        self._parting.pop(name, None)
        if self.leases.count(name):
            self._finish_batches()  # it may have answered before it left
        self._sender.forget_link(name)
        self._counters.add("jobs_lost", self._book.remove_worker(name))

    def _on_pattern(self, sample: zenoh.Sample) -> None:
        if (new := self.decoder.add_pattern(sample.key_expr, sample.payload)) is not None:
            self._patterns = [*self._patterns, new][-MAX_NEW_PATTERNS:]
            self._sender.prepare_for(*new, name_in("pattern", sample.key_expr, "worker"))
