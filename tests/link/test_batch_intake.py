# SPDX-License-Identifier: MIT
"""Messages of factors are taken in by a thread, and count by what is known of their jobs at the end."""

import logging
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh

from protocol.channels import key
from protocol.counters import Counters
from protocol.messages_pb2 import FactorBatch
from sim_server.network import batch_decoder, batch_intake
from sim_server.network.answers import Answers
from sim_server.network.batch_intake import BatchIntake
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.leases import Leases
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming
from tests.support.answered_batch import KINDS, MADE, answered
from tests.support.in_flight import batch_in_flight

CLOSED = object()
NAMES = list(KINDS)


class Ring:
    """A subscriber, whose messages reach the thread unless it is held."""

    def __init__(self) -> None:
        self.waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.held: queue.SimpleQueue[Any] | None = None

    def put(self, message: FactorBatch) -> None:
        sample = SimpleNamespace(key_expr=key("factors", worker="w"), attachment=message.SerializeToString())
        (self.waiting if self.held is None else self.held).put(sample)

    def recv(self) -> Any:
        if (sample := self.waiting.get()) is CLOSED:
            raise zenoh.ZError("closed")
        return sample

    def try_recv(self) -> Any:
        try:
            return None if self.held is None else self.held.get_nowait()
        except queue.Empty:
            return None


class Stage:
    """An intake, the message that answers all jobs of one batch, and what becomes of it."""

    def __init__(self) -> None:
        made, self.ring = answered(), Ring()
        self.message, self.batch, self.decoder, self.values = made.message, made.batch, made.decoder, made.values
        self.counters, self.leases = Counters(logging.getLogger("test")), Leases(None)
        registry, reliability = WorkerRegistry(7, 9.0), WorkerReliability()
        self.book = Bookkeeping(registry, self.leases, WorkerTiming(), reliability, self.decoder, time.monotonic)
        self.closed = False
        session: Any = SimpleNamespace(declare_subscriber=lambda *_: self.ring, is_closed=lambda: self.closed)
        self.intake = BatchIntake(session, "s", self.counters, self.book, Answers(self.counters, self.book))
        self.thread = threading.Thread(target=self.intake.run, daemon=True)
        self.thread.start()
        self.leases.next_numbers(len(NAMES))
        self.leases.start(self.batch)

    def send(self, message: FactorBatch | None = None) -> None:
        """Sends a message, and waits until the thread has done with it."""
        done = self.intake.done
        self.ring.put(self.message if message is None else message)
        until(lambda: self.intake.done > done)

    def take(self) -> set[str]:
        """Takes what the thread has done; returns the objects that have a factor now, which must be theirs."""
        self.intake.take(self.intake.done)
        found = {name for each in self.intake.together for name in each.objects}
        for factors in self.intake.together:
            for factor in factors:
                np.testing.assert_array_equal(factor.values, self.values[factor.object])
        self.intake.together = []
        return found

    def failed(self) -> set[str]:
        return {name for name, _ in self.book.failures}


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage()
    yield made
    made.ring.waiting.put(CLOSED)


def test_factors_are_told_once_they_are_taken_and_their_jobs_are_over_then(stage):
    stage.send()
    assert len(stage.intake) == len(NAMES) and all(number in stage.intake for number in stage.batch.numbers)
    assert stage.intake.together == [] and stage.leases.count("w") == len(NAMES)
    assert stage.take() == set(NAMES)
    assert len(stage.intake) == 0 and stage.leases.count("w") == 0 and stage.failed() == set()


def test_of_a_job_that_is_over_meanwhile_nothing_is_told(stage):
    stage.send()
    stage.leases.forget_object("b")  # it has a new epoch
    stage.leases.reassign(1.0, lambda job: job.object == "d")
    stage.leases.start(batch_in_flight(range(99, 100), ["d"], 1, 7, "float32", "v", 9.0))  # another worker has it now
    assert stage.take() == {"a", "c", "e"} and stage.counters.refusals == {"epoch": 1}
    assert stage.leases.count("w") == 0 and stage.failed() == set()


def test_a_pattern_that_is_read_after_its_factors_came_is_in_time(stage):
    """The thread may be at a message before the patterns are read that were sent ahead of it."""
    known = stage.decoder.objects["c"]
    held, known.patterns = known.patterns, {}
    stage.send()
    known.patterns = held
    assert stage.take() == set(NAMES) and stage.counters.refusals == {} and stage.leases.count("w") == 0


def test_a_pattern_that_was_never_sent_is_refused(stage):
    stage.decoder.objects["c"].patterns = {}
    stage.send()
    assert stage.take() == set(NAMES) - {"c"} and stage.failed() == {"c"} and stage.counters.refusals == {"pattern": 1}
    assert stage.leases.count("w") == 0


def test_each_answer_counts_once(stage):
    stage.message.jobs.append(stage.message.jobs[1])
    for column in ("patterns", "nonzeros", "checksums", "seconds"):
        getattr(stage.message, column).append(getattr(stage.message, column)[1])
    stage.send()
    stage.send()
    assert stage.take() == set(NAMES) and stage.counters.refusals == {"duplicate": 2 + len(NAMES)}
    assert stage.failed() == set()


def test_what_is_no_answer_to_this_batch_costs_the_others_nothing(stage):
    """A failure, a job that does not exist, and one of another batch, which is in another slot."""
    other = batch_in_flight(range(50, 51), ["b"], 1, 5, "float32", "w", 9.0)
    stage.leases.finish(stage.leases.by_object["b"])
    stage.leases.start(other)
    stage.message.jobs[1], stage.message.jobs[4] = 50, 1 << 40
    stage.message.failures.extend(["", "", "not positive definite", "", ""])
    stage.send()
    assert stage.take() == {"a", "d"}
    assert stage.failed() == {"b", "c"} and stage.counters.refusals == {"slot": 1, "sequence": 1}
    assert [job.object for job in stage.leases.jobs] == ["e"]


def test_a_message_that_cannot_be_read_is_refused_and_the_next_is_taken(stage):
    bad = FactorBatch()
    bad.CopyFrom(stage.message)
    bad.header.incarnation = 8
    stage.send(bad)
    stage.send()
    assert stage.take() == set(NAMES) and stage.counters.refusals == {"incarnation": 1}


def test_an_error_that_no_check_foresees_costs_its_message_alone(stage, monkeypatch):
    with monkeypatch.context() as broken:
        broken.setattr(batch_intake, "decode_several", lambda *_: {}["nose"])
        stage.send()
    assert stage.take() == set() and stage.failed() == set(NAMES) and stage.leases.count("w") == 0
    assert stage.counters.refusals == {"unexpected": len(NAMES)} and len(stage.intake) == 0
    stage.leases.start(replace(stage.batch))
    stage.send()
    assert stage.take() == set(NAMES)


def test_an_error_while_a_message_is_taken_ends_its_jobs(stage, monkeypatch):
    monkeypatch.setattr(Answers, "duration", lambda *_: {}["nose"])
    stage.send()
    assert stage.take() == set() and stage.failed() == set(NAMES) and stage.leases.count("w") == 0
    assert stage.counters.refusals == {"unexpected": 1} and len(stage.intake) == 0


def test_jobs_of_a_message_that_fails_as_it_is_taken_are_not_taken_in_any_more(stage, monkeypatch):
    """Else their leases would never be over, and their objects never have a factor again."""
    monkeypatch.setattr(Leases, "match_answer", lambda *_: {}["nose"])
    stage.message.jobs[2] = 1 << 40
    stage.send()
    with pytest.raises(KeyError):
        stage.take()
    assert len(stage.intake) == 0 and stage.leases.count("w") == len(NAMES)


def test_messages_that_nobody_takes_are_no_more_than_so_many(stage):
    """Others wait in the ring, which is bounded; once some were taken the thread goes on."""
    for _ in range(batch_intake.WAITING):
        stage.send()
    stage.ring.put(stage.message)
    time.sleep(0.05)
    assert stage.intake.done == batch_intake.WAITING and stage.ring.waiting.qsize() == 1
    assert stage.take() == set(NAMES)
    until(lambda: stage.intake.done)
    assert stage.take() == set() and stage.ring.waiting.empty()


def test_what_waits_for_the_thread_is_taken_before_a_worker_is_forgotten(stage):
    stage.ring.held = queue.SimpleQueue()
    stage.ring.put(stage.message)
    stage.intake.finish()
    assert stage.take() == set(NAMES) and stage.leases.count("w") == 0


def test_what_is_taken_before_a_worker_is_forgotten_makes_no_room_for_more(stage):
    """Also where as many wait as may: else the bound would grow with each worker that leaves."""
    for _ in range(batch_intake.WAITING):
        stage.send()
    stage.ring.held = queue.SimpleQueue()
    for _ in range(3):
        stage.ring.put(stage.message)
    stage.intake.finish()
    stage.ring.held = None
    assert stage.take() == set(NAMES) and stage.intake.done == 0
    for _ in range(batch_intake.WAITING):
        stage.send()
    stage.ring.put(stage.message)
    time.sleep(0.05)
    assert stage.intake.done == batch_intake.WAITING and stage.ring.waiting.qsize() == 1


def test_the_thread_ends_with_the_session_though_nobody_takes_messages_any_more(stage, monkeypatch):
    monkeypatch.setattr(batch_intake, "LOOK_PERIOD", 0.01)
    for _ in range(batch_intake.WAITING):
        stage.send()
    stage.thread.join(0.1)
    assert stage.thread.is_alive()
    stage.closed = True
    stage.thread.join(60)
    assert not stage.thread.is_alive()


def test_until_a_message_is_taken_its_worker_has_done_its_jobs(stage, monkeypatch):
    seen: list[int] = []
    decode = batch_intake.decode_several

    def watched(*arguments: Any) -> Any:
        seen.extend([stage.intake.done_by("w"), stage.intake.done_by("v")])
        return decode(*arguments)

    monkeypatch.setattr(batch_intake, "decode_several", watched)
    stage.send()
    assert seen == [len(NAMES), 0]
    assert [stage.intake.done_by(name) for name in "wv"] == seen, "who sends jobs has not taken it yet"
    stage.intake.take(1)
    assert stage.intake.done_by("w") == 0


def test_a_message_does_not_wait_for_the_one_before_while_there_is_another_thread(stage, monkeypatch):
    """Jobs are taken then in another order than they were answered in, which makes no time negative."""
    threading.Thread(target=stage.intake.run, daemon=True).start()
    go, decode = threading.Event(), batch_intake.decode_several

    def held(*arguments: Any) -> Any:
        assert arguments[1].jobs[0] != stage.batch.numbers[0] or go.wait(60)
        return decode(*arguments)

    monkeypatch.setattr(batch_intake, "decode_several", held)
    first, second = parts(stage.message, [0, 1]), parts(stage.message, [2, 3, 4])
    stage.ring.put(first)
    until(lambda: len(stage.intake) == 2)
    stage.send(second)
    assert stage.intake.done_by("w") == len(NAMES)
    assert stage.take() == {"c", "d", "e"} and len(stage.intake) == 2
    done = threading.Thread(target=stage.intake.finish)
    done.start()  # waits for the first
    go.set()
    done.join(60)
    assert stage.take() == {"a", "b"} and stage.leases.count("w") == 0 and stage.counters.refusals == {}
    assert min(stage.book.timing.expected("w", name) for name in NAMES) >= 0
    stage.ring.waiting.put(CLOSED)


def parts(message: FactorBatch, places: list[int]) -> FactorBatch:
    """The answers at some places."""
    some = FactorBatch(header=message.header, worker=message.worker, slot=message.slot)
    for column in ("jobs", "patterns", "nonzeros", "checksums", "seconds"):
        getattr(some, column).extend(getattr(message, column)[k] for k in places)
    return some


def until(condition: Any) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(1e-3)


@pytest.mark.parametrize("positions", [False, True])
def test_jobs_of_which_the_matrices_are_known_are_checked(stage, monkeypatch, positions):
    """With the matrix of each, whatever the order of the answers; not by positions."""
    count = len(NAMES)
    stage.batch.matrices_at, stage.batch.bodies = 1000 + np.arange(count), 10 + np.arange(count)
    stage.batch.positions = positions
    asked: list[Any] = []
    given: list[Any] = []
    stage.intake.begin_check = lambda *jobs: asked.append(jobs)
    real = batch_decoder.take_in

    def watched(source: Any, patterns: Any, memory: Any, check: Any, matrices: Any) -> Any:
        given.append(matrices)
        return real(source, patterns, memory)

    monkeypatch.setattr(batch_decoder, "take_in", watched)
    order = [3, 0, 4, 1, 2]
    for column in ("jobs", "patterns", "nonzeros", "checksums", "seconds"):
        values = list(getattr(stage.message, column))
        del getattr(stage.message, column)[:]
        getattr(stage.message, column).extend(values[k] for k in order)
    stage.send()
    if positions:
        assert asked == [] and given == [None]
    else:
        ((objects, epochs, patterns),) = asked
        assert objects == [NAMES[k] for k in order] and epochs == [1] * count
        assert [pattern.id for pattern in patterns] == [MADE[KINDS[name]].pattern.id for name in objects]
        assert given[0].tolist() == [1000 + k for k in order]
    stage.intake.take(1)
    together = stage.intake.together
    bodies = {name: int(body) for each in together for name, body in zip(each.objects, each.bodies, strict=True)}
    assert bodies == {name: 10 + k for k, name in enumerate(NAMES)} and stage.take() == set(NAMES)
