# SPDX-License-Identifier: MIT
"""Takes in the factors of messages of several, in threads of its own: each receives a message, copies its factors out
of shared memory, checks them and has them made ready for use. The thread that sends jobs sees a message once, at its
end.

What is known of jobs is only read here, and may change meanwhile; whether the answers still count is decided in `take`.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial

import zenoh
from zenoh.handlers import RingChannel

from protocol.channels import key
from protocol.counters import Counters
from protocol.messages_pb2 import FactorBatch
from protocol.refused import Refused
from sim_server.backends.factors_together import FactorsTogether
from sim_server.network.answers import Answers
from sim_server.network.batch_decoder import NONE, DecodedFactors, decode_several
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.updates.take_in import BeginCheck

LOOK_PERIOD = 0.5  # s between looks at whether the session is closed, while no room for another message is made
WAITING = 64  # messages that may wait to be taken in, beyond which the oldest is lost, and as many to be taken


@dataclass(eq=False)
class Arrived:
    """A message with answers to several jobs.

    at: when it came [s, monotonic]
    jobs: of one batch, that are answered with factors; told: their places in the message
    others: places of all other answers
    decoded: their factors
    """

    message: FactorBatch
    at: float
    jobs: list[InFlightJob] = field(default_factory=list)
    told: list[int] = field(default_factory=list)
    others: list[int] = field(default_factory=list)
    decoded: DecodedFactors = NONE


class BatchIntake:
    """Factors of messages.

    together: that passed all checks, until they are told
    wake: called in a thread when a message is done
    begin_check: as of FactorSource.check_with
    """

    def __init__(self, session: zenoh.Session, server: str, counters: Counters, book: Bookkeeping, answers: Answers):
        self._session, self._counters, self._book, self._answers = session, counters, book, answers
        self.together: list[FactorsTogether] = []
        self.wake: Callable[[], None] = lambda: None
        self.begin_check: BeginCheck = lambda *jobs: None
        self._beside: set[int] = set()  # numbers of jobs whose factors are taken in
        self._under_way: dict[int, Arrived] = {}  # by thread
        self._done: deque[Arrived | Refused] = deque()  # oldest first
        self._working: list[threading.Lock] = []  # of each thread, held while it takes a message in
        self._room = threading.Semaphore(WAITING)  # for messages that are done
        self._ring = session.declare_subscriber(key("factors", server), RingChannel(WAITING))

    def __contains__(self, number: int) -> bool:
        """True while the factor of a job is taken in."""
        return number in self._beside

    def __len__(self) -> int:
        return len(self._beside)

    def done_by(self, worker: str) -> int:
        """Number of jobs that a worker has done, whose factors are copied and checked now, or were and are to be taken.
        Those of messages that wait for a thread are left out: no more are to wait for it."""
        arrived = {id(each): each for each in (*self._under_way.values(), *self._done) if isinstance(each, Arrived)}
        return sum(len(each.jobs) for each in arrived.values() if each.message.worker == worker)

    # ---- in the threads of messages ------------------------------------------------------------------------

    def run(self) -> None:
        """Takes messages in until the session is closed. In as many threads as there are to be."""
        working = threading.Lock()
        self._working.append(working)
        while self._has_room():
            try:
                sample = self._ring.recv()
            except zenoh.ZError:  # the session was closed
                return
            with working:
                self._take_in(sample)
            self.wake()

    def _has_room(self) -> bool:
        """Waits until one more message may be taken in; False once the session is closed."""
        while not self._room.acquire(timeout=LOOK_PERIOD):
            if self._session.is_closed():  # who sends jobs takes none any more
                return False
        return True

    def _take_in(self, sample: zenoh.Sample) -> None:
        """Takes a message in. Whatever it holds, the run goes on."""
        try:
            self._done.append(self._arrived(sample))
        except Refused as refusal:
            self._done.append(refusal)
        except Exception as error:
            self._done.append(self._counters.unexpected(error, f"a message {str(sample.key_expr)[:200]!r}"))
        self._under_way.pop(threading.get_ident(), None)

    def _arrived(self, sample: zenoh.Sample) -> Arrived:
        """Returns a message with the factors that answer jobs which are waited for."""
        message = self._book.decoder.parse_batch(sample.key_expr, sample.attachment)
        arrived = Arrived(message, self._book.clock())
        self._match(arrived)
        if arrived.jobs:
            self._beside.update(job.number for job in arrived.jobs)
            self._under_way[threading.get_ident()] = arrived
            arrived.decoded = self._decode(message, arrived.jobs, arrived.told, self.begin_check)
        return arrived

    def _match(self, arrived: Arrived) -> None:
        """Finds the answers that bring factors of jobs of one batch that are waited for."""
        numbers, failures = list(arrived.message.jobs), arrived.message.failures
        flying = self._book.leases.by_worker.get(arrived.message.worker, {})
        waited, found = self._book.leases.by_object, [flying.get(number) for number in numbers]
        batch, seen = next((job.batch for job in found if job is not None), None), set[int]()
        for place, (number, job) in enumerate(zip(numbers, found, strict=True)):
            first = number not in seen and number not in self._beside and not (failures and failures[place])
            if first and job is not None and job.batch is batch and waited.get(job.object) is job:
                seen.add(number)
                arrived.jobs.append(job)
                arrived.told.append(place)
            else:
                arrived.others.append(place)

    def _decode(
        self, message: FactorBatch, jobs: Sequence[InFlightJob], told: Sequence[int], begin_check: BeginCheck | None
    ) -> DecodedFactors:  # fmt: skip
        """Returns what `decode_several` does. Whatever error it raises, the factors are refused and the run goes on."""
        try:
            return decode_several(self._book.decoder, message, jobs, told, begin_check)
        except Exception as error:
            and_more = f" and {len(jobs) - 1} more" if len(jobs) > 1 else ""
            what = f"factors of {jobs[0].object}{and_more} by worker {message.worker}"
            refusal = self._counters.unexpected(error, what)
            return DecodedFactors([], [(k, refusal) for k in range(len(jobs))])

    # ---- in the thread of jobs -----------------------------------------------------------------------------

    @property
    def done(self) -> int:
        """Number of messages that `take` could take now. Patterns that came before these messages are there."""
        return len(self._done)

    def finish(self) -> None:
        """Takes all messages that have come, also those that wait for a thread, before a worker is forgotten."""
        with ExitStack() as held:
            for working in list(self._working):
                held.enter_context(working)
            while (sample := self._ring.try_recv()) is not None:
                if not self._room.acquire(blocking=False):
                    self.take(self.done)
                    self._room.acquire(blocking=False)
                self._take_in(sample)
        self.take(self.done)

    def take(self, count: int) -> None:
        """Takes the factors of the oldest messages, unless their jobs are over, and notes why others did not pass."""
        for _ in range(count):
            arrived = self._done.popleft()
            self._room.release()
            if isinstance(arrived, Refused):
                self._counters.refuse(arrived)
                continue
            try:
                self._book.registry.mark_seen(arrived.message.worker, arrived.at)
                others = self._matched(arrived) if arrived.others else []
                if jobs := [*arrived.jobs, *(job for _, job in others)]:
                    self._answers.guarded(jobs, partial(self._take, arrived, others))
            finally:
                self._beside.difference_update(job.number for job in arrived.jobs)

    def _matched(self, arrived: Arrived) -> list[tuple[int, InFlightJob]]:
        """Returns place and job of the other answers that are of a job in flight and the first to it."""
        leases, found, seen = self._book.leases, [], set[int]()
        for place in arrived.others:
            number = arrived.message.jobs[place]
            try:
                job = leases.match_answer(number, arrived.message.worker, None)
                if number in seen or number in self._beside:
                    raise Refused(f"FactorBatch.jobs has {number}, already answered", "duplicate")
                seen.add(number)
                found.append((place, job))
            except Refused as refusal:
                self._counters.refuse(refusal)
        return found

    def _take(self, arrived: Arrived, others: Sequence[tuple[int, InFlightJob]]) -> None:
        message, jobs = arrived.message, [*arrived.jobs, *(job for _, job in others)]
        lasted = self._answers.duration(jobs[0], arrived.at) / len(message.jobs)
        self._answers.note(message.worker)
        # What the thread has decoded, but for patterns that had not been read then
        late = [k for k, refusal in arrived.decoded.refused if refusal.kind == "pattern"]
        refused = [each for each in arrived.decoded.refused if each[0] not in late]
        self._take_decoded(message, arrived.jobs, DecodedFactors(arrived.decoded.good, refused), lasted)
        # Other answers
        again = [(arrived.told[k], arrived.jobs[k]) for k in late if self._is_current(arrived.jobs[k])]
        for place, job in [*again, *(each for each in others if not self._ends(message, *each))]:
            self._take_decoded(message, [job], self._decode(message, [job], [place], None), lasted)

    def _ends(self, message: FactorBatch, place: int, job: InFlightJob) -> bool:
        """Takes an answer that brings no factor that is waited for; False if it brings one."""
        if self._book.leases.is_reassigned(job):
            self._book.leases.finish(job)
        elif message.failures and message.failures[place]:
            self._answers.fail(job, message.failures[place])
        else:
            return False
        return True

    def _take_decoded(
        self, message: FactorBatch, jobs: Sequence[InFlightJob], decoded: DecodedFactors, lasted: float
    ) -> None:  # fmt: skip
        """Takes factors that passed all checks. lasted: from matrix to factor, of each [s]"""
        answered = [jobs[k] for places, _ in decoded.good for k in places] + [jobs[k] for k, _ in decoded.refused]
        if answered:
            self._answers.guarded(answered, partial(self._take_good, message, jobs, decoded, lasted))

    def _take_good(
        self, message: FactorBatch, jobs: Sequence[InFlightJob], decoded: DecodedFactors, lasted: float
    ) -> None:  # fmt: skip
        book, by_slot = self._book, (message.matrix_shared, True)
        taken: list[tuple[list[InFlightJob], FactorsTogether]] = []
        for places, factors in decoded.good:
            own = [jobs[k] for k in places]
            rows = [row for row, job in enumerate(own) if self._is_current(job)]
            if len(rows) < len(own):
                own, factors = [own[row] for row in rows], factors.of(rows)
            if rows:
                taken.append((own, factors))
        self.together += [factors for _, factors in taken]
        try:
            for _, factors in taken:
                book.timing.record_all(factors.worker, factors.objects, lasted, factors.seconds)
        finally:  # they will be used
            for own, factors in taken:
                book.leases.finish_all(own, factors.seconds)
        for own, factors in taken:
            self._answers.count(own[0], len(own) * factors.values[0].nbytes, by_slot, len(own))  # of one pattern
        for k, refusal in decoded.refused:
            if self._is_current(jobs[k]):
                self._answers.refuse(jobs[k], refusal, by_slot)

    def _is_current(self, job: InFlightJob) -> bool:
        """True if the factor of a job, which was decoded, is waited for."""
        leases = self._book.leases
        if leases.by_object.get(job.object) is job:
            return True
        try:
            leases.finish(leases.match_answer(job.number, job.worker, job.epoch))  # another worker has it now
        except Refused as refusal:
            self._counters.refuse(refusal)
        return False
