# SPDX-License-Identifier: MIT
"""Takes in what workers answer: factors alone, in batches and in parts, large ones beside the caller."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import zenoh

from protocol.counters import Counters
from protocol.factor import Factor
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.messages_pb2 import FactorBatch
from protocol.refused import Refused
from protocol.shared_memory.pool import Slot, SlotPool
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.batch_decoder import DecodedFactors, decode_several
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.factor_fetch import AHEAD, FactorFetch
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.updates.take_in import BeginCheck

T = TypeVar("T")

LARGE = 4 << 20  # bytes of a factor whose copy and checks take more than a few milliseconds
LARGE_MESSAGE = 1 << 19  # bytes of the factors of a message, for which it takes a tenth of one: it comes often
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


class DecodedTogether(NamedTuple):
    """Factors of one message.

    matrix_shared: matrices travelled in shared memory
    duration: from matrix to factor of each [s]
    """

    jobs: Sequence[InFlightJob]
    matrix_shared: bool
    duration: float


class FactorIntake:
    """Checks answers against the jobs in flight, and collects their factors. Methods raise Refused.

    pool: shared memory for parts; None: they travel as bytes
    factors, together: that passed all checks, those that came alone and those of messages, until they are told
    """

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: int, pool: SlotPool | None, counters: Counters,
        book: Bookkeeping,
    ):  # fmt: skip
        self._session, self._server, self._incarnation = session, server, incarnation
        self._pool, self._counters, self._book = pool, counters, book
        self._thread = ThreadPoolExecutor(1, "large factors")
        self._messages = ThreadPoolExecutor(1, "factors of messages")  # small ones, which wait for no large one
        self._fetching = ThreadPoolExecutor(FETCHES, "parts of factors")
        self.factors: list[Factor] = []
        self.together: list[FactorsTogether] = []
        self._decoding: dict[int, Decoding] = {}  # beside the caller, by number of the job
        self._together: deque[tuple[DecodedTogether, Future[DecodedFactors]]] = deque()  # likewise, oldest first
        self._beside: set[int] = set()  # numbers of their jobs
        self._fetches: set[int] = set()  # of these, the jobs whose factors come in parts
        self.wake: Callable[[], None] = lambda: None  # called in another thread when a factor is decoded
        self.begin_check: BeginCheck = lambda *jobs: None  # (FactorSource.check_with)

    def fetched_from(self, worker: str) -> int:
        """Number of jobs that a worker has done, and whose factors are fetched from it part by part, or copied and
        checked beside the caller: those of one message at most, as no more are to wait for that."""
        beside = next((len(each.jobs) for each, _ in self._together if each.jobs and each.jobs[0].worker == worker), 0)
        return beside + sum(self._decoding[number].job.worker == worker for number in self._fetches)

    def is_decoded(self, job: InFlightJob) -> bool:
        """True while the answer to a job is taken in beside the caller."""
        return job.number in self._decoding or job.number in self._beside

    @property
    def decoded(self) -> int:
        """Number of answers that are taken in beside the caller."""
        return len(self._decoding) + len(self._beside)

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
        self._note_answer(job.worker)
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
        self._take_factor(job, decode, message.failure, message.seconds, _slots_used(message))

    def on_factors(self, sample: zenoh.Sample) -> None:
        """Takes answers to jobs of a batch, each by itself: what is wrong with one costs the others nothing."""
        message = self._book.decoder.parse_batch(sample.key_expr, sample.attachment)
        self._book.registry.mark_seen(message.worker, self._book.clock())
        answers = self._matched(message)
        if not answers:
            return
        duration = self._duration(answers[0][1]) / len(message.jobs)
        self._note_answer(message.worker)
        good = [(place, job) for place, job in answers if not self._ends(message, place, job)]
        together = DecodedTogether([job for _, job in good], message.matrix_shared, duration)
        if 4 * sum(message.nonzeros) <= LARGE_MESSAGE:
            decode = partial(self._all_decoded, message, good, None)
            return self._guarded(together.jobs, partial(self._take_together, together, decode))
        decode = partial(self._all_decoded, message, good, self.begin_check)
        self._together.append((together, self._begun(self._messages, decode)))
        self._beside.update(job.number for job in together.jobs)

    def _matched(self, message: FactorBatch) -> list[tuple[int, InFlightJob]]:
        """Returns place and job of the answers that are of a job in flight and the first to it."""
        leases, found, seen = self._book.leases, [], set()
        flying = leases.by_worker.get(message.worker, {})
        for place, number in enumerate(message.jobs):
            try:
                job = flying.get(number)
                if job is None or leases.by_object.get(job.object) is not job:
                    job = leases.match_answer(number, message.worker, None)  # which tells what is wrong
                if number in seen or number in self._beside or number in self._decoding:
                    raise Refused(f"FactorBatch.jobs has {number}, already answered", "duplicate")
                seen.add(number)
                found.append((place, job))
            except Refused as refusal:
                self._counters.refuse(refusal)
        return found

    def _ends(self, message: FactorBatch, place: int, job: InFlightJob) -> bool:
        """Takes an answer that brings no factor that is waited for; False if it brings one."""
        if self._book.leases.is_reassigned(job):
            self._book.leases.finish(job)
        elif failure := _failure(message, place):
            self._take_factor(job, _no_factor, failure, 0.0, (True, True))
        else:
            return False
        return True

    def _decoded(self, job: InFlightJob, decode: Callable[[], Factor]) -> Factor:
        """Returns the factor that `decode` returns. Whatever error it raises, the factor is refused and the run goes
        on. From any thread."""
        try:
            return decode()
        except Refused:
            raise
        except Exception as error:
            raise self._counters.unexpected(error, f"factor of {job.object} by worker {job.worker}") from error

    def _all_decoded(
        self, message: FactorBatch, answers: Sequence[tuple[int, InFlightJob]], begin_check: BeginCheck | None
    ) -> DecodedFactors:  # fmt: skip
        """Returns what `decode_several` does, likewise."""
        try:
            return decode_several(self._book.decoder, message, answers, begin_check)
        except Exception as error:
            first, *others = [job.object for _, job in answers]
            and_more = f" and {len(others)} more" if others else ""
            refusal = self._counters.unexpected(error, f"factors of {first}{and_more} by worker {message.worker}")
            return DecodedFactors([], [(k, refusal) for k in range(len(answers))])

    def _begun(self, thread: ThreadPoolExecutor, decode: Callable[[], T]) -> Future[T]:
        """Has a thread decode, and who takes in factors woken at the end."""
        try:
            future = thread.submit(decode)
        except RuntimeError as error:  # "can't start new thread"
            future = Future()
            future.set_exception(self._counters.unexpected(error, "factors of workers"))
        future.add_done_callback(lambda _: self.wake())
        return future

    def _note_answer(self, worker: str) -> None:
        self._book.free_since[worker] = self._book.clock()
        self._book.reliability.on_answer(worker)

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

    def take_decoded(self) -> None:
        """Takes the large factors that were decoded beside the caller, unless their jobs are over."""
        for number in self._fetches:
            job, fetch = self._decoding[number].job, self._decoding[number].fetch
            if fetch is not None and self._book.leases.by_object.get(job.object) is not job:
                fetch.give_up()
        while self._together and self._together[0][1].done():
            together, future = self._together.popleft()
            self._beside.difference_update(job.number for job in together.jobs)
            self._guarded(together.jobs, partial(self._take_together, together, future.result))
        for number in [number for number, each in self._decoding.items() if each.future.done()]:
            each = self._decoding.pop(number)
            self._fetches.discard(number)
            self._guarded([each.job], partial(self._end_decoding, each))

    def _guarded(self, jobs: Sequence[InFlightJob], take: Callable[[], None]) -> None:
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
        self._take_factor(current, each.take, "", each.seconds, by_slot)

    def _take_together(self, together: DecodedTogether, results: Callable[[], DecodedFactors]) -> None:
        """Takes the factors of a message that passed all checks, unless their jobs are over, and notes why others did
        not."""
        decoded, by_slot = results(), (together.matrix_shared, True)
        taken: list[tuple[list[InFlightJob], FactorsTogether]] = []
        for places, factors in decoded.good:
            jobs = [together.jobs[k] for k in places]
            rows = [row for row, job in enumerate(jobs) if self._is_current(job)]
            if len(rows) < len(jobs):
                jobs, factors = [jobs[row] for row in rows], factors.of(rows)
            if rows:
                taken.append((jobs, factors))
        self.together += [factors for _, factors in taken]
        try:
            for _, factors in taken:
                self._book.timing.record_all(factors.worker, factors.objects, together.duration, factors.seconds)
        finally:  # they will be used
            for jobs, factors in taken:
                self._book.leases.finish_all(jobs, factors.seconds)
        for jobs, factors in taken:
            self._count(jobs[0], sum(values.nbytes for values in factors.values), by_slot, len(jobs))
        for k, refusal in decoded.refused:
            if self._is_current(job := together.jobs[k]):
                try:
                    self._take_factor(job, partial(_refuse, refusal), "", 0.0, by_slot)
                except Refused as told:
                    self._counters.refuse(told)

    def _is_current(self, job: InFlightJob) -> bool:
        """True if the factor of a job, which was decoded, is waited for."""
        leases = self._book.leases
        if leases.by_object.get(job.object) is job and leases.is_in_flight(job):
            return True
        try:
            leases.finish(leases.match_answer(job.number, job.worker, job.epoch))  # another worker has it now
        except Refused as refusal:
            self._counters.refuse(refusal)
        return False

    def _take_factor(
        self, job: InFlightJob, decode: Callable[[], Factor], failure: str, told: float, by_slot: tuple[bool, bool]
    ) -> None:  # fmt: skip
        """Takes the answer to a job: the factor that `decode` returns, or a failure.

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
            book.timing.record(job.worker, job.object, self._duration(job), seconds)
        except Refused as refusal:
            if refusal.kind != "unexpected":  # which may well be an error of this process, and last
                book.reliability.on_failure(job.worker, job.object, book.clock())
            book.fail(job, f"was refused: {refusal}")
            raise
        finally:
            book.leases.finish(job, seconds)
        self._count(job, self.factors[-1].values.nbytes, by_slot)

    def _duration(self, job: InFlightJob) -> float:
        """Time [s] from matrix to factor, without that for which the job waited behind others of its worker."""
        now = self._book.clock()
        last, self._book.answered_at[job.worker] = self._book.answered_at.get(job.worker, 0.0), now
        return now - max(job.sent_at, last)

    def _count(self, job: InFlightJob, size: int, by_slot: tuple[bool, bool], factors: int = 1) -> None:
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


def _failure(message: FactorBatch, place: int) -> str:
    """Why a worker made no factor for a job of a batch; empty if it did."""
    return message.failures[place] if message.failures else ""


def _no_factor() -> Factor:
    """Raises Refused: the worker has told why there is none."""
    raise Refused("there is no factor", "malformed")


def _refuse(refusal: Refused) -> Factor:
    """Raises Refused: the factor did not pass a check."""
    raise refusal


def _slots_used(message: FactorMessage, fetch: FactorFetch | None = None) -> tuple[bool, bool]:
    """Whether matrix and factor travelled in shared memory. fetch: of its parts"""
    in_slot = message.HasField("slot") or message.HasField("device_slot")
    return message.matrix_shared, in_slot or (fetch is not None and bool(fetch.slots))
