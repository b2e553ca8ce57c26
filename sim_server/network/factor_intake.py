# SPDX-License-Identifier: MIT
"""Takes in the factors that workers send alone: in one message or in parts, large ones beside the caller. Those of
messages of several: batch_intake.py."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import zenoh

from protocol.counters import Counters
from protocol.factor import Factor
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot, SlotPool
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.answers import Answers
from sim_server.network.batch_intake import BatchIntake
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.factor_fetch import AHEAD, FactorFetch
from sim_server.network.jobs_in_flight import InFlightJob

T = TypeVar("T")

LARGE = 4 << 20  # bytes of a factor whose copy and checks take more than a few milliseconds
FETCHES = 2  # factors that arrive in parts at a time, each in memory of its own


class Decoding(NamedTuple):
    """A factor that is taken in beside the caller.

    future: that is over once it is done, and `take` returns the factor, or raises Refused
    seconds, by_slot: as of FactorIntake._take_factor
    fetch: of its parts, if it comes in parts
    """

    job: InFlightJob
    future: Future[Any]
    take: Callable[[], Factor]
    seconds: float
    by_slot: tuple[bool, bool]
    fetch: FactorFetch | None = None


class FactorIntake:
    """Checks answers against the jobs in flight, and collects their factors. Methods raise Refused.

    pool: shared memory for parts; None: they travel as bytes
    batches: takes in those of messages of several
    """

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: int, pool: SlotPool | None, counters: Counters,
        book: Bookkeeping,
    ):  # fmt: skip
        self._session, self._server, self._incarnation = session, server, incarnation
        self._pool, self._counters, self._book = pool, counters, book
        self._answers = Answers(counters, book)
        self.batches = BatchIntake(session, server, counters, book, self._answers)
        self._thread = ThreadPoolExecutor(1, "large factors")
        self._fetching = ThreadPoolExecutor(FETCHES, "parts of factors")
        self._decoding: dict[int, Decoding] = {}  # beside the caller, by number of the job
        self._fetches: set[int] = set()  # of these, the jobs whose factors come in parts
        self._wake: Callable[[], None] = lambda: None

    def wake_by(self, wake: Callable[[], None]) -> None:
        """Has `wake` called in another thread when factors are decoded there."""
        self._wake = self.batches.wake = wake

    def alone(self) -> list[Factor]:
        """Returns the factors that came alone and passed all checks since the last call."""
        factors, self._answers.factors = self._answers.factors, []
        return factors

    def together(self) -> list[FactorsTogether]:
        """Returns likewise those of messages of several."""
        together, self.batches.together = self.batches.together, []
        return together

    def fetched_from(self, worker: str) -> int:
        """Number of jobs that a worker has done, and whose factors are fetched from it part by part, or copied and
        checked beside the caller, or were: those of one message at most are under way, as no more are to wait for that.
        """
        return self.batches.done_by(worker) + sum(
            self._decoding[number].job.worker == worker for number in self._fetches
        )

    def is_decoded(self, job: InFlightJob) -> bool:
        """True while the answer to a job is taken in beside the caller."""
        return job.number in self._decoding or job.number in self.batches

    @property
    def decoded(self) -> int:
        """Number of answers that are taken in beside the caller."""
        return len(self._decoding) + len(self.batches)

    def is_arriving(self, job: InFlightJob) -> bool:
        """True while the answer to a job is taken in, unless it comes in parts and none comes any more."""
        each = self._decoding.get(job.number)
        stalls = each is not None and each.fetch is not None and each.fetch.stalls
        return self.is_decoded(job) and not stalls

    # ---- messages --------------------------------------------------------------------------------------------

    def on_factor(self, sample: zenoh.Sample) -> None:
        """Takes the answer to a job that went alone."""
        message = self._book.decoder.parse_factor(sample.key_expr, sample.attachment)
        job = self._book.leases.match_answer(message.job, message.worker, message.header.epoch)
        self._book.registry.mark_seen(job.worker, self._book.clock())
        self._answers.note(job.worker)
        if self._book.leases.is_reassigned(job):
            return self._book.leases.finish(job, None if message.failure else message.seconds)
        if message.parts and not message.failure:
            return self._fetch(message, job)
        decode = partial(self._decoded, job, partial(self._book.decoder.decode, message, sample.payload, job))
        on_device = message.HasField("device_slot")
        if not message.failure and (on_device or 4 * message.nonzeros > LARGE):  # copied and checked beside the caller
            self._refuse_second(job)
            future = self._begun(self._thread, decode)
            self._decoding[job.number] = Decoding(job, future, future.result, message.seconds, _slots_used(message))
            return
        self._answers.take(job, decode, message.failure, message.seconds, _slots_used(message))

    def _decoded(self, job: InFlightJob, decode: Callable[[], Factor]) -> Factor:
        """Returns the factor that `decode` returns. Whatever error it raises, the factor is refused and the run goes
        on. From any thread."""
        try:
            return decode()
        except Refused:
            raise
        except Exception as error:
            raise self._counters.unexpected(error, f"factor of {job.object} by worker {job.worker}") from error

    def _begun(self, thread: ThreadPoolExecutor, decode: Callable[[], T]) -> Future[T]:
        """Has a thread decode, and who takes in factors woken at the end."""
        try:
            future = thread.submit(decode)
        except RuntimeError as error:  # "can't start new thread"
            future = Future()
            future.set_exception(self._counters.unexpected(error, "factors of workers"))
        future.add_done_callback(lambda _: self._wake())
        return future

    def _refuse_second(self, job: InFlightJob) -> None:
        if self.is_decoded(job):
            raise Refused(f"Factor.job is {job.number}, already answered", "duplicate")

    # ---- factors in parts ------------------------------------------------------------------------------------

    def _fetch(self, message: FactorMessage, job: InFlightJob) -> None:
        """Begins to fetch a factor in parts, beside the caller. Its worker is free for the jobs of other objects."""
        self._refuse_second(job)
        fetch = FactorFetch(
            self._session, self._server, self._incarnation, self._counters, job, message.nonzeros, message.parts,
            self._slots_for_parts(job),
        )  # fmt: skip
        decode = partial(self._decoded, job, partial(self._book.decoder.decode, message, b"", job, fetch.run))
        future, by_slot = self._begun(self._fetching, decode), _slots_used(message, fetch)
        self._decoding[job.number] = Decoding(job, future, future.result, message.seconds, by_slot, fetch=fetch)
        self._fetches.add(job.number)

    def _slots_for_parts(self, job: InFlightJob) -> list[Slot]:
        """Allocates the slots of a fetch; none if parts must travel as bytes."""
        info = self._book.registry.info(job.worker)
        if self._pool is None or info is None or not info.shared_memory:
            return []
        slots = [slot for slot in (self._pool.lend(job.part_bytes) for _ in range(AHEAD)) if slot is not None]
        if len(slots) == AHEAD:
            return slots
        self._give_back(slots)
        return []

    def _give_back(self, slots: Sequence[Slot], clean: bool = True) -> None:
        """Frees the slots of a fetch. clean: nobody writes to them any more."""
        if self._pool is not None:
            for slot in slots:
                (self._pool.give_back if clean else self._pool.discard)(slot)

    def _end_gone(self, job: InFlightJob) -> None:
        """Frees the worker of a job that is over, if it is still there."""
        leases = self._book.leases
        if leases.is_in_flight(job):
            if leases.is_reassigned(job):  # its parts did not come
                self._book.reliability.on_failure(job.worker, job.object, self._book.clock())
            leases.finish(job)

    # ---- factors that are there ------------------------------------------------------------------------------

    def take_decoded(self, batches: int) -> None:
        """Takes the factors that were decoded beside the caller, unless their jobs are over. batches: number of
        messages of several"""
        self.batches.take(min(batches, self.batches.done))
        for number in self._fetches:
            job, fetch = self._decoding[number].job, self._decoding[number].fetch
            if fetch is not None and self._book.leases.by_object.get(job.object) is not job:
                fetch.give_up()
        for number in [number for number, each in self._decoding.items() if each.future.done()]:
            each = self._decoding.pop(number)
            self._fetches.discard(number)
            self._answers.guarded([each.job], partial(self._end_decoding, each))

    def _end_decoding(self, each: Decoding) -> None:
        job, fetch, by_slot = each.job, each.fetch, each.by_slot
        if fetch is not None:
            self._give_back(fetch.slots, fetch.clean)
            if fetch.gone.is_set():  # why its job is over was told
                return self._end_gone(job)
            by_slot = by_slot[0], bool(fetch.slots)
        current = self._book.leases.match_answer(job.number, job.worker, job.epoch)
        if self._book.leases.is_reassigned(current):
            return self._book.leases.finish(current)
        self._answers.take(current, each.take, "", each.seconds, by_slot)


def _slots_used(message: FactorMessage, fetch: FactorFetch | None = None) -> tuple[bool, bool]:
    """Whether matrix and factor travelled in shared memory. fetch: of its parts"""
    in_slot = message.HasField("slot") or message.HasField("device_slot")
    return message.matrix_shared, in_slot or (fetch is not None and bool(fetch.slots))
