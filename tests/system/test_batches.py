# SPDX-License-Identifier: MIT
"""Jobs of many small objects in one message, and their answers: each counts by itself."""

import math
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hand_worker import HandWorker
from link_helpers import DenseAnalysis, Driver, chain, dense, light_worker, matrix, product
from zenoh.handlers import RingChannel

from protocol.channels import MOST_JOBS, key
from protocol.messages_pb2 import FactorBatch, MatrixBatch
from protocol.shared_memory.limits import obstacle
from protocol.shared_memory.view import SlotMap
from protocol.validate import checksum
from sim_server.network import batch_decoder, batch_intake, batch_sender, sending, worker_choice
from sim_server.network.batch_message import MOST_TOGETHER
from sim_server.network.inbox import Inbox
from sim_server.network.job_sender import JobSender
from sim_server.network.link import ServerLink
from sim_server.network.send_queue import SendQueue
from sim_server.network.worker_timing import WorkerTiming
from sim_server.updates.factor_check import FactorCheck
from sim_server.updates.factor_source import Job
from sim_server.updates.jobs_together import JobsTogether
from sim_server.updates.take_in import BegunCheck
from tests.ports import free_endpoint

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(bool(obstacle()), reason=f"no shared memory here: {obstacle()}"),
]

NAMES = ("a", "b", "c", "d")
BEAMS = {name: chain(6 + k, name) for k, name in enumerate(NAMES)}  # of different sizes
ANALYSES = {
    name: DenseAnalysis(np.frombuffer(beam.row_start, np.int32), np.frombuffer(beam.columns, np.int32))
    for name, beam in BEAMS.items()
}


def jobs(step: int, names: tuple[str, ...] = NAMES, **changes: Any) -> list[Job]:
    """A matrix of each, another one at each step."""
    return [Job(n, 1, step, True, matrix(BEAMS[n], shift(n, step)), **changes) for n in names]


def shift(name: str, step: int) -> float:
    return 0.1 * NAMES.index(name) + 0.01 * step


class Hand:
    """A worker played by hand that takes batches."""

    def __init__(self, driver: Driver, hand: HandWorker):
        self.driver, self.hand, self.slots, self.step = driver, hand, SlotMap(), 0
        self.received = hand.session.zenoh.declare_subscriber(key("matrices", worker="hand"), RingChannel(64))

    def hello(self, **changes: Any) -> None:
        self.hand.hello(pid=os.getpid(), **({"most_jobs": 64, "batches": True, "shared_memory": True} | changes))

    def first_factors(self) -> None:
        """One of each alone, after which their sizes are known."""
        for name in NAMES:
            self.driver.submit(BEAMS[name], 0)
            answer, values = self.hand.right_answer(self.hand.receive(), BEAMS[name])
            self.hand.answer(answer, values)
            self.driver.until(lambda name=name: any(f.object == name for f in self.driver.factors), "a first factor")

    def batch(
        self, names: tuple[str, ...] = NAMES, form: Callable[[list[Job]], Sequence[Job]] = list
    ) -> MatrixBatch:  # fmt: skip
        """Has the server send one; its matrices are what was given."""
        self.step += 1
        self.driver.factors.clear()
        self.driver.failures.clear()
        self.driver.until(lambda: self.driver.link.dispatch.ready() >= len(names), "room")
        assert self.driver.link.dispatch.submit_many(form(jobs(self.step, names))) == [True] * len(names)
        sample = self.driver.until(self.received.try_recv, "the batch")
        batch = MatrixBatch.FromString(bytes(sample.attachment))
        values = self.slots.array(batch.matrix_slot, np.float64, 9 * sum(batch.blocks))
        parts = np.split(values, np.cumsum(9 * np.array(batch.blocks))[:-1])
        for name, part, check in zip(batch.objects, parts, batch.checksums, strict=True):
            assert np.array_equal(part.reshape(-1, 3, 3), matrix(BEAMS[name], shift(name, self.step)))
            assert checksum(part) == check
        return batch

    def answer(self, batch: MatrixBatch, places: list[int] | None = None, edit: Any = None) -> FactorBatch:
        """What a good worker would answer to jobs at these places, but for what `edit` does to the values."""
        places = list(range(len(batch.jobs))) if places is None else places
        rooms = np.cumsum([0, *batch.rooms])
        message = FactorBatch(header=self.hand.header(), worker="hand", slot=batch.factor_slot, matrix_shared=True)
        room = self.slots.array(batch.factor_slot, np.uint8, int(rooms[-1]))
        for place in places:
            name = batch.objects[place]
            values = ANALYSES[name].factorize(matrix(BEAMS[name], shift(name, self.step)), np.float32)
            values = values if edit is None else edit(place, values)
            room[rooms[place] : rooms[place] + values.nbytes].view(np.float32)[:] = values
            message.jobs.append(batch.jobs[place])
            message.patterns.append(ANALYSES[name].pattern.id)
            message.nonzeros.append(len(values))
            message.checksums.append(checksum(values))
            message.seconds.append(1e-4)
        return message

    def send(self, message: FactorBatch) -> None:
        self.hand.put("factors", b"", message.SerializeToString(), worker="hand")

    def made(self) -> set[str]:
        return {factor.object for factor in self.driver.factors}

    def failed(self) -> set[str]:
        return {name for name, _ in self.driver.failures}

    def check_factors(self) -> None:
        for factor in self.driver.factors:
            expected = dense(BEAMS[factor.object], matrix(BEAMS[factor.object], shift(factor.object, self.step)))
            assert np.allclose(product(factor), expected, atol=1e-5) and factor.step == self.step


@contextmanager
def staged(clock: Callable[[], float] | None = None) -> Iterator[Hand]:
    """A server and a worker by hand, who has made a factor of each object. clock: of the server; None: its own"""
    endpoint, options = free_endpoint(), {} if clock is None else {"clock": clock}
    with (
        ServerLink(listen=[endpoint], silence=600, **options) as link,
        HandWorker(endpoint, link.incarnation, shared_memory=True) as hand,
    ):
        played = Hand(Driver(link), hand)
        for beam in BEAMS.values():
            link.announce(beam)
        played.hello()
        played.driver.until(link.dispatch.ready, "the worker")
        played.first_factors()
        yield played


@pytest.fixture(scope="module")
def stage() -> Iterator[Hand]:
    patch = pytest.MonkeyPatch()
    patch.setattr(worker_choice, "QUEUE_SECONDS", 60.0)
    with staged() as played:
        yield played
    patch.undo()


def all_are_back(hand: Hand) -> bool:
    return hand.made() | hand.failed() == set(NAMES)


def test_a_batch_is_one_message_each_way(stage: Hand) -> None:
    batch = stage.batch()
    assert list(batch.objects) == list(NAMES) and list(batch.steps) == [stage.step] * 4 and list(batch.known) == [1] * 4
    assert stage.driver.link.slots_lent == 2, "one for the matrices, one for the factors"
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: all_are_back(stage), "the factors")
    stage.check_factors()
    assert stage.made() == set(NAMES) and stage.driver.link.slots_lent == 0


def test_answers_may_come_in_parts_and_in_any_order(stage: Hand) -> None:
    batch = stage.batch()
    stage.send(stage.answer(batch, [3, 1]))
    stage.driver.until(lambda: stage.made() == {"b", "d"}, "two of them")
    assert stage.driver.link.slots_lent == 2, "the others may still write to theirs"
    stage.send(stage.answer(batch, [2, 0]))
    stage.driver.until(lambda: all_are_back(stage), "the others")
    stage.check_factors()
    assert stage.driver.link.slots_lent == 0


def test_jobs_by_columns_travel_as_a_list_of_them(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """All at once, as long as one worker has room and all may share batches; else one by one."""
    one_by_one, real, told = list[int](), JobSender.submit_sorted, []

    def submit_sorted(sender: JobSender, jobs: Sequence[Job], *others: Any) -> list[bool]:
        one_by_one.append(len(jobs))
        return real(sender, jobs, *others)

    monkeypatch.setattr(JobSender, "submit_sorted", submit_sorted)
    dispatch = stage.driver.link.dispatch
    for name in NAMES:
        dispatch.factor_helped("hand", name)  # what failed in other tests is forgotten
    for form in (list, JobsTogether.of):
        batch = stage.batch(form=form)
        told.append({name: list(getattr(batch, name)) for name in ("objects", "epochs", "warps", "blocks", "rooms")})
        stage.send(stage.answer(batch))
        stage.driver.until(lambda: stage.made() == set(NAMES), "their factors")
    assert told[0] == told[1] and one_by_one == [4]
    flying = stage.batch(("a", "b"), form=JobsTogether.of)
    assert one_by_one == [4] and dispatch.submit_many(JobsTogether.of(jobs(950, ("b",) * 2))) == [False] * 2
    stage.send(stage.answer(flying))
    stage.driver.until(lambda: stage.made() == {"a", "b"}, "their factors")
    with pytest.raises(ValueError, match="not announced"):
        dispatch.submit_many(JobsTogether.of([replace(job, epoch=2) for job in jobs(950)]))
    with pytest.raises(ValueError, match="values"):
        dispatch.submit_many(JobsTogether.of([replace(job, values=job.values[1:]) for job in jobs(950)]))
    assert one_by_one == [4, 2, 4, 4] and not dispatch.leases.jobs
    dispatch.factor_failed("hand", "a")
    for names, expected in ((("b", "c"), 4), (("a", "b"), 5)):  # only a job of an object that failed is looked at
        flying = stage.batch(names, form=JobsTogether.of)
        assert len(one_by_one) == expected
        stage.send(stage.answer(flying))
        stage.driver.until(lambda names=names: stage.made() == set(names), "their factors")
    dispatch.factor_helped("hand", "a")


def test_messages_are_taken_in_once_a_round(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rooms are asked for again once something was sent."""
    dispatch, read, real = stage.driver.link.dispatch, list[int](), Inbox.__iter__

    def looked(inbox: Inbox) -> Any:
        read.append(1)
        return real(inbox)

    stage.driver.until(lambda: dispatch.ready() == 64 and not stage.driver.link.slots_lent, "room")
    stage.driver.factors.clear()
    monkeypatch.setattr(Inbox, "__iter__", looked)
    with dispatch.round():
        assert dispatch.ready() == 64 and dispatch.submit_many(JobsTogether.of(jobs(980))) == [True] * 4
        assert dispatch.ready() == 60 and not dispatch.poll() and len(dispatch.workers()) == 1 and len(read) == 1
    assert dispatch.ready() == 60 and len(read) == 2
    with pytest.raises(ZeroDivisionError), dispatch.round():
        raise ZeroDivisionError
    assert dispatch.ready() == 60 and len(read) == 4
    stage.step, sample = 980, stage.driver.until(stage.received.try_recv, "the batch")
    stage.send(stage.answer(MatrixBatch.FromString(bytes(sample.attachment))))
    stage.driver.until(lambda: stage.made() == set(NAMES), "their factors")


def test_jobs_of_several_messages_are_shared_evenly(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small message costs about as much as a large one."""
    monkeypatch.setattr(batch_sender, "MOST_TOGETHER", 3)
    stage.driver.factors.clear()
    stage.driver.until(lambda: stage.driver.link.dispatch.ready() >= 4, "room")
    stage.step = 970
    assert stage.driver.link.dispatch.submit_many(JobsTogether.of(jobs(970))) == [True] * 4
    told = []
    for _ in range(2):
        batch = MatrixBatch.FromString(bytes(stage.driver.until(stage.received.try_recv, "a batch").attachment))
        told.append(list(batch.objects))
        stage.send(stage.answer(batch))
    stage.driver.until(lambda: stage.made() == set(NAMES), "their factors")
    stage.check_factors()
    assert told == [["a", "b"], ["c", "d"]]


def test_jobs_for_which_there_is_no_room_are_not_taken(stage: Hand) -> None:
    dispatch = stage.driver.link.dispatch
    stage.hello(most_jobs=3)
    stage.driver.until(lambda: dispatch.ready() == 3, "the hello")
    assert dispatch.submit_many(JobsTogether.of(jobs(960))) == [True] * 3 + [False]
    stage.step, sample = 960, stage.driver.until(stage.received.try_recv, "the batch")
    stage.send(stage.answer(MatrixBatch.FromString(bytes(sample.attachment))))
    stage.driver.until(lambda: stage.made() >= {"a", "b", "c"} and not dispatch.leases.jobs, "their factors")
    stage.hello()
    stage.driver.until(lambda: dispatch.ready() == 64, "the hello")


def test_an_object_alone_goes_as_ever(stage: Hand) -> None:
    stage.driver.factors.clear()
    stage.driver.until(lambda: stage.driver.link.dispatch.submit_many(jobs(900, ("c",))) == [True], "room")
    job = stage.hand.receive()
    assert (job.header.object, job.step) == ("c", 900) and stage.received.try_recv() is None
    answer, values = stage.hand.right_answer(job, BEAMS["c"], shift("c", 900))
    stage.hand.answer(answer, values)
    stage.driver.until(lambda: stage.made() == {"c"}, "its factor")


def test_types_and_methods_are_not_mixed(stage: Hand) -> None:
    stage.driver.factors.clear()
    mixed = [*jobs(901, ("a", "b")), *jobs(901, ("c", "d"), dtype="float64")]
    stage.driver.until(lambda: stage.driver.link.dispatch.ready() >= 4, "room")
    assert stage.driver.link.dispatch.submit_many(mixed) == [True] * 4
    found = [
        MatrixBatch.FromString(bytes(stage.driver.until(stage.received.try_recv, "a batch").attachment))
        for _ in range(2)
    ]
    assert sorted((b.factor_dtype, *b.objects) for b in found) == [("float32", "a", "b"), ("float64", "c", "d")]
    for batch in found:
        stage.send(_failing(stage, batch))
    stage.driver.until(lambda: stage.failed() == set(NAMES), "the failures")


def _failing(stage: Hand, batch: MatrixBatch) -> FactorBatch:
    count = len(batch.jobs)
    return FactorBatch(
        header=stage.hand.header(), worker="hand", slot=batch.factor_slot, jobs=batch.jobs, patterns=[0] * count,
        nonzeros=[0] * count, checksums=[0] * count, seconds=[0.0] * count, failures=["not today"] * count,
    )  # fmt: skip


Spoil = Callable[[FactorBatch], None]


def field(name: str, value: Any) -> Spoil:
    def spoil(message: FactorBatch) -> None:
        getattr(message, name)[1] = value

    return spoil


# What is wrong with the second of four answers, in the message or the first value of its factor, and how it is refused.
ONE: dict[str, tuple[str, Spoil | float]] = {
    "checksum": ("checksum", field("checksums", 7)),
    "pattern never sent": ("pattern", field("patterns", 7)),
    "size": ("shape", field("nonzeros", 2**62)),
    "NaN seconds": ("malformed", field("seconds", math.nan)),
    "negative seconds": ("malformed", field("seconds", -1.0)),
    "NaN": ("not_finite", math.nan),
    "negative diagonal": ("not_positive", -1.0),
}


@pytest.mark.parametrize("name", ONE)
def test_what_is_wrong_with_one_costs_the_others_nothing(stage: Hand, name: str) -> None:
    kind, wrong = ONE[name]

    def edit(place: int, values: np.ndarray) -> np.ndarray:
        if place == 1 and isinstance(wrong, float):
            values[0] = wrong
        return values

    batch, before = stage.batch(), stage.driver.link.counters.refusals[kind]
    message = stage.answer(batch, edit=edit)
    if callable(wrong):
        wrong(message)
    stage.send(message)
    stage.driver.until(lambda: all_are_back(stage), "the answers")
    stage.check_factors()
    assert stage.made() == {"a", "c", "d"} and stage.failed() == {"b"}
    assert stage.driver.link.counters.refusals[kind] == before + 1 and stage.driver.link.slots_lent == 0


def test_an_error_that_no_check_foresees_costs_its_message_alone(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: Any) -> None:
        raise IndexError("index 7 is out of bounds")

    batch, refusals = stage.batch(), stage.driver.link.counters.refusals["unexpected"]
    monkeypatch.setattr(batch_decoder, "take_in", broken)
    stage.send(stage.answer(batch, [0, 2]))
    stage.driver.until(lambda: stage.failed() == {"a", "c"}, "the refusals")
    assert "was refused: factors of a and 1 more by worker hand: IndexError" in stage.driver.failures[0][1]
    assert stage.driver.link.counters.refusals["unexpected"] == refusals + 2
    monkeypatch.undo()
    stage.send(stage.answer(batch, [1, 3]))
    stage.driver.until(lambda: all_are_back(stage), "the others")
    stage.check_factors()
    assert stage.made() == {"b", "d"} and stage.driver.link.slots_lent == 0


def test_factors_are_used_and_their_jobs_over_though_taking_note_of_them_fails(
    stage: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: Any) -> None:
        raise IndexError("index 7 is out of bounds")

    batch, refusals = stage.batch(), stage.driver.link.counters.refusals["unexpected"]
    monkeypatch.setattr(WorkerTiming, "record_all", broken)
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: all_are_back(stage), "the answers")
    stage.check_factors()
    assert len(stage.made()) == 4 and not stage.driver.failures and stage.driver.link.slots_lent == 0
    assert stage.driver.link.counters.refusals["unexpected"] == refusals + 1


def test_a_failed_job_is_told_with_its_reason(stage: Hand) -> None:
    batch = stage.batch()
    message = stage.answer(batch)
    message.failures.extend(["", "", "", "not positive definite"])
    stage.send(message)
    stage.driver.until(lambda: all_are_back(stage), "the answers")
    assert stage.made() == {"a", "b", "c"} and "failed: not positive definite" in stage.driver.failures[0][1]


def put(name: str, value: Any) -> Spoil:
    return lambda message: setattr(message, name, value)


# Wrong as a whole: nothing of it counts, and the right answers may still come.
WHOLE: dict[str, tuple[str, Spoil]] = {
    "a list too short": ("shape", lambda m: m.nonzeros.__delitem__(-1)),
    "a list too long": ("shape", lambda m: m.seconds.append(0.0)),
    "one reason for four": ("shape", lambda m: m.failures.append("why")),
    "no job": ("shape", lambda m: m.ClearField("jobs")),
    "other worker": ("worker", put("worker", "other")),
    "other protocol": ("version", lambda m: setattr(m.header, "protocol", 99)),
    "an earlier life": ("incarnation", lambda m: setattr(m.header, "incarnation", 1)),
    "too many": ("size", lambda m: m.jobs.extend([1 << 40] * (1 << 17))),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_malformed_answer_changes_nothing(stage: Hand, name: str) -> None:
    kind, spoil = WHOLE[name]
    batch, before = stage.batch(), stage.driver.link.counters.refusals[kind]
    message = stage.answer(batch)
    spoil(message)
    stage.send(message)
    stage.driver.until(lambda: stage.driver.link.counters.refusals[kind] == before + 1, "the refusal")
    assert not stage.driver.factors and not stage.driver.failures
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: stage.made() == set(NAMES), "the right ones")


def test_answers_of_no_job_and_second_answers_are_refused_one_by_one(stage: Hand) -> None:
    batch, refusals = stage.batch(), stage.driver.link.counters.refusals
    before = refusals["sequence"], refusals["duplicate"]
    message = stage.answer(batch, [0, 0, 1, 2, 3])
    message.jobs[3] = 10**9
    stage.send(message)
    stage.driver.until(lambda: stage.made() == {"a", "b", "d"}, "three of them")
    assert (refusals["sequence"], refusals["duplicate"]) == (before[0] + 1, before[1] + 1)
    stage.send(stage.answer(batch, [2]))
    stage.driver.until(lambda: stage.made() == set(NAMES), "the last one")


@pytest.mark.parametrize("known", [True, False])
def test_large_batches_are_checked_where_they_are_decoded(
    stage: Hand, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    """By what the driver gives for just these jobs, if it gives anything."""
    check = FactorCheck(
        {n: (np.frombuffer(b.row_start, np.int32), np.frombuffer(b.columns, np.int32)) for n, b in BEAMS.items()}
    )
    residuals: dict[str, float] = {}

    def begin(objects: Any, epochs: Any, patterns: Any) -> BegunCheck | None:
        assert set(epochs) == {1}
        bodies = check.bodies(objects, epochs, patterns)
        assert bodies is not None
        return BegunCheck(bodies, 0, end) if known else None

    def end(factors: Any, taken: Any) -> None:
        assert threading.current_thread() is not threading.main_thread()
        residuals.update(zip(factors.objects, taken.found["judged"][:, 4].tolist(), strict=True))
        factors.reasons = [f"of {name}" for name in factors.objects]

    dispatch = stage.driver.link.dispatch
    dispatch.check_with(begin)
    real, found = dispatch.poll_together, []
    monkeypatch.setattr(dispatch, "poll_together", lambda: [found.append(each) or each for each in real()])
    batch = stage.batch()
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: all_are_back(stage), "the factors")
    dispatch.check_with(lambda *jobs: None)  # other tests use this link, too
    reasons = {n: why for each in found for n, why in zip(each.objects, each.reasons or [""] * len(each), strict=True)}
    assert reasons == {name: f"of {name}" if known else "" for name in NAMES}
    assert set(residuals) == (set(NAMES) if known else set())
    assert all(0 < residual < 1e-4 for residual in residuals.values()), "each with its own matrix"
    stage.check_factors()


def test_batches_are_decoded_beside_the_caller(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """Meanwhile nothing is taken; then each counts alone, and second answers are refused."""
    dispatch = stage.driver.link.dispatch
    free = dispatch.ready()
    batch, go = stage.batch(), threading.Event()
    assert dispatch.ready() == free - len(NAMES)
    decode, before = batch_intake.decode_several, stage.driver.link.counters.refusals["duplicate"]

    def slow(*arguments: Any) -> Any:
        assert go.wait(30)
        return decode(*arguments)

    monkeypatch.setattr(batch_intake, "decode_several", slow)
    message = stage.answer(batch, [0, 1, 1, 2, 3])
    message.checksums[3] = 7
    stage.send(message)
    stage.send(stage.answer(batch, [0]))
    stage.driver.until(lambda: dispatch.decoding == len(NAMES), "the begin")
    assert not stage.driver.factors and stage.driver.link.slots_lent == 2
    assert dispatch.ready() == free, "its worker has done them"
    go.set()
    stage.driver.until(lambda: all_are_back(stage), "the factors")
    stage.check_factors()
    assert stage.made() == {"a", "b", "d"} and stage.failed() == {"c"} and stage.driver.link.slots_lent == 0
    stage.driver.until(lambda: stage.driver.link.counters.refusals["duplicate"] == before + 2, "the second answers")


def test_what_waits_behind_a_first_job_has_longer(stage: Hand) -> None:
    """A worker that has not had an object yet may have to compile and analyse for it."""
    new = chain(5, "new")
    stage.driver.link.announce(new)
    stage.driver.submit(new, 1)
    batch = stage.batch()
    leases = {job.object: job.deadline - job.sent_at for job in stage.driver.link.dispatch.leases.jobs}
    assert {name: round(leases[name]) for name in NAMES} == dict.fromkeys(NAMES, round(sending.BEHIND))
    assert leases["new"] > 2 * sending.BEHIND, "but not as long: a message may be lost"
    answer, values = stage.hand.right_answer(stage.hand.receive(), new)
    stage.hand.answer(answer, values)
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: stage.made() == {"new", *NAMES}, "all factors")


def test_a_slot_of_another_generation_is_not_read(stage: Hand) -> None:
    batch = stage.batch()
    message = stage.answer(batch)
    message.slot.generation += 1
    stage.send(message)
    stage.driver.until(lambda: stage.failed() == set(NAMES), "the refusals")
    assert not stage.driver.factors and stage.driver.link.slots_lent == 0


def test_an_object_whose_mesh_changed_loses_its_own_factor_alone(stage: Hand) -> None:
    batch, before = stage.batch(), stage.driver.link.counters.refusals["epoch"]
    stage.driver.link.announce(chain(9, "b", epoch=2))
    stage.send(stage.answer(batch))
    stage.driver.until(lambda: all_are_back(stage), "the answers")
    assert stage.made() == {"a", "c", "d"} and stage.failed() == {"b"}
    assert stage.driver.link.counters.refusals["epoch"] == before + 1 and stage.driver.link.slots_lent == 0
    stage.driver.link.announce(BEAMS["b"])
    stage.first_factors()


def test_slots_are_not_lent_again_before_they_are_sent(stage: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are filled by the thread that sends them, even if nobody waits for the jobs any more."""
    dispatch, held = stage.driver.link.dispatch, list[Callable[[], None]]()
    stage.driver.until(lambda: dispatch.ready() >= len(NAMES) and not stage.driver.link.slots_lent, "room")
    monkeypatch.setattr(SendQueue, "post", lambda queue, send, name=None: held.append(send) or True)
    assert dispatch.submit_many(jobs(950)) == [True] * len(NAMES)
    dispatch.leases.cancel(dispatch.leases.jobs[0].batch)
    stage.driver.turn()
    assert len(held) == 1 and stage.driver.link.slots_lent == 2
    held[0]()
    stage.driver.until(lambda: not stage.driver.link.slots_lent, "the slots")
    assert stage.driver.until(stage.received.try_recv, "the batch") is not None


def test_some_full_batches_are_in_flight_at_most(stage: Hand) -> None:
    """However many a worker takes, and however fast it says that it is: the others would wait, and grow old."""
    dispatch = stage.driver.link.dispatch
    takes_more = lambda: [w for w in dispatch.workers() if w.most_jobs == MOST_JOBS]  # noqa: E731
    stage.hello(most_jobs=MOST_JOBS)
    stage.driver.until(takes_more, "the hello")
    assert dispatch.ready() == worker_choice.MOST_BATCHES * MOST_TOGETHER < MOST_JOBS
    stage.hello()
    stage.driver.until(lambda: not takes_more(), "the hello")
    assert dispatch.ready() == 64, "and no more than it takes"


def test_a_worker_of_an_older_version_gets_them_one_by_one(stage: Hand) -> None:
    stage.hello(batches=False)
    info = lambda: [w for w in stage.driver.link.dispatch.workers() if not w.batches]  # noqa: E731
    stage.driver.until(info, "the hello")
    assert stage.driver.link.dispatch.submit_many(jobs(902)) == [True] * 4
    for _ in NAMES:
        job = stage.hand.receive()
        answer, values = stage.hand.right_answer(job, BEAMS[job.header.object], shift(job.header.object, 902))
        stage.hand.answer(answer, values)
    assert stage.received.try_recv() is None
    stage.hello()
    stage.driver.until(lambda: not info(), "the hello")


def test_a_real_worker_answers_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve objects of three sizes, forty rounds: each factor is that of its own matrix."""
    monkeypatch.setattr(worker_choice, "QUEUE_SECONDS", 60.0)
    endpoint, names = free_endpoint(), [f"beam{k}" for k in range(12)]
    beams = [chain(5 + k % 3, name) for k, name in enumerate(names)]
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint):
        driver, messages = Driver(link), [0]
        counting = threading.Lock()

        def count(sample: Any) -> None:
            with counting:
                messages[0] += 1

        with HandWorker(endpoint, link.incarnation, "listener") as other:
            listening = other.session.zenoh.declare_subscriber(key("factors", worker="light"), count)
            for beam in beams:
                link.announce(beam)
            for beam in beams:
                assert driver.factor(beam, 1)
                driver.factors.clear()
            for step in range(2, 42):
                driver.factors.clear()
                given = [
                    Job(n, 1, step, True, matrix(b, 0.1 * k + 0.01 * step))
                    for k, (n, b) in enumerate(zip(names, beams, strict=True))
                ]
                driver.until(lambda: link.dispatch.ready() >= len(names), "room")
                assert all(link.dispatch.submit_many(given))
                driver.until(lambda: len(driver.factors) == len(names), "all factors")
                for factor in driver.factors:
                    k = names.index(factor.object)
                    expected = dense(beams[k], matrix(beams[k], 0.1 * k + 0.01 * step))
                    assert np.allclose(product(factor), expected, atol=1e-5) and factor.step == step
            listening.undeclare()
        assert 40 <= messages[0] <= 40 * len(names) and driver.failures == [] and link.counters.refused == 0
        assert link.slots_lent == 0 and link.counters.bulk_shared >= 2 * 40 * len(names)
