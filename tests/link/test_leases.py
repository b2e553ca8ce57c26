# SPDX-License-Identifier: MIT
"""Leases of jobs in flight, without a network."""

import gc
import weakref
from typing import Any

import pytest

from protocol.refused import Refused
from sim_server.network.jobs_in_flight import InFlightJob
from sim_server.network.lease_terms import DELIVERY, MAX_LEASE, MIN_LEASE
from sim_server.network.leases import Leases
from tests.support.in_flight import batch_in_flight, in_flight


class Allocator:
    def __init__(self) -> None:
        self.back: list[object] = []

    def give_back(self, slot: object, users: int = 1) -> None:
        self.back += [slot] * users


def sent(
    leases: Leases, object: str = "beam", worker: str = "w", deadline: float = 2.0, epoch: int = 1, **others: Any
) -> InFlightJob:
    (number,) = leases.next_numbers(1)
    slots = (f"slot {number}",)
    started = in_flight(number, object, epoch, 1, "float32", worker, deadline, **({"slots": slots} | others))
    leases.start(started.batch)
    return started


@pytest.fixture
def allocator() -> Allocator:
    return Allocator()


@pytest.fixture
def leases(allocator: Allocator) -> Leases:
    return Leases(allocator)


def test_an_answer_frees_object_worker_and_slots(leases: Leases, allocator: Allocator) -> None:
    first = sent(leases)
    assert leases.match_answer(1, "w", 1) is first
    leases.finish(first, 0.5)
    assert (leases.by_object, leases.by_worker, allocator.back) == ({}, {}, ["slot 1"])
    with pytest.raises(Refused, match="already answered") as refused:
        leases.match_answer(1, "w", 1)
    assert refused.value.kind == "duplicate"


def test_nothing_holds_slots_of_a_job_that_is_over(leases: Leases) -> None:
    """Those that were dropped meanwhile are free at once: the garbage collector comes by seldom."""

    class Memory:
        pass

    memory = Memory()
    gone, started = weakref.ref(memory), sent(leases, slots=(memory,))
    del memory
    gc.disable()
    try:
        leases.finish(started, 0.5)
        leases._allocator.back.clear()  # type: ignore[union-attr]
        del started
        assert gone() is None
    finally:
        gc.enable()


def test_answers_of_a_message_free_what_each_would_alone(allocator: Allocator) -> None:
    """Jobs of one message share their slots, which are free once all are answered."""

    def run(together: bool) -> tuple[Leases, list[object]]:
        allocator.back = []
        leases = Leases(allocator)
        sent(leases, "late", deadline=0.5)
        leases.expire(1.0)
        numbers, slots = leases.next_numbers(4), ("matrices", "factors")
        batch = batch_in_flight(numbers, list("abcd"), 1, 1, "float32", "w", 2.0, slots=slots)
        jobs = batch.jobs
        leases.start(batch)
        if together:
            leases.finish_all(jobs[:3], [0.1, 0.2, 0.3])
        else:
            for job, seconds in zip(jobs[:3], (0.1, 0.2, 0.3), strict=True):
                leases.finish(job, seconds)
        return leases, allocator.back

    (one, back), (other, expected) = run(True), run(False)
    assert sorted(back) == sorted(expected) and back.count("factors") == 3 and "slot 1" in back
    assert one.by_object.keys() == other.by_object.keys() == {"d"} and one.count("w") == other.count("w") == 1
    assert one.deadlines() == other.deadlines() and one.expired_count("w") == other.expired_count("w") == 0
    for name in "abcd":
        assert one.terms.lease(name, "w") == other.terms.lease(name, "w")
        assert one.terms.exclusive_period(name, 10) == other.terms.exclusive_period(name, 10)


@pytest.mark.parametrize(
    ("number", "worker", "epoch", "kind"),
    [(2, "w", 1, "sequence"), (0, "w", 1, "sequence"), (1, "x", 1, "duplicate"), (1, "w", 2, "epoch")],
)
def test_answers_to_nothing_leave_the_job_alone(
    leases: Leases, number: int, worker: str, epoch: int, kind: str
) -> None:
    first = sent(leases)
    with pytest.raises(Refused) as refused:
        leases.match_answer(number, worker, epoch)
    assert refused.value.kind == kind
    assert leases.by_object == {"beam": first} and leases.jobs == [first]


def test_a_lease_that_ends_frees_object_and_worker_but_not_the_slots(leases: Leases, allocator: Allocator) -> None:
    first = sent(leases, deadline=2.0)
    assert leases.expire(1.9) == []
    assert leases.expire(2.1) == [first]
    assert (leases.by_object, leases.by_worker, allocator.back, leases.expired_count("w")) == ({}, {}, [], 1)
    with pytest.raises(Refused) as refused:
        leases.match_answer(1, "w", 1)
    assert refused.value.kind == "late"
    assert allocator.back == ["slot 1"] and leases.expired_count("w") == 0


def test_an_answer_to_a_later_job_frees_the_slots_of_late_ones(leases: Leases, allocator: Allocator) -> None:
    sent(leases, deadline=1.0)
    leases.expire(2.0)
    second = sent(leases, deadline=3.0)
    leases.finish(leases.match_answer(second.number, "w", 1))
    assert sorted(map(str, allocator.back)) == ["slot 1", "slot 2"]


def test_several_jobs_of_a_worker_are_answered_in_any_order(leases: Leases, allocator: Allocator) -> None:
    first, second, third = (sent(leases, object=name, deadline=9.0 + k) for k, name in enumerate("abc"))
    assert leases.count("w") == 3 and leases.deadlines() == {"w": 11.0}
    leases.finish(leases.match_answer(second.number, "w", 1), 0.1)
    assert leases.jobs == [first, third] and allocator.back == ["slot 2"]
    assert leases.expire(9.5) == [first] and leases.count("w") == 1 and allocator.back == ["slot 2"]
    assert leases.remove_worker("w") == [third] and leases.jobs == [] and leases.count("w") == 0
    assert sorted(map(str, allocator.back)) == ["slot 1", "slot 2", "slot 3"]


def test_leaving_frees_everything_of_the_worker(leases: Leases, allocator: Allocator) -> None:
    sent(leases, deadline=1.0)
    leases.expire(2.0)
    second = sent(leases, deadline=9.0)
    other = sent(leases, object="liver", worker="x")
    assert leases.remove_worker("w") == [second]
    assert sorted(map(str, allocator.back)) == ["slot 1", "slot 2"]
    assert leases.by_object == {"liver": other} and leases.remove_worker("w") == []


def test_a_new_epoch_frees_the_object_at_once_and_the_worker_when_it_answers(
    leases: Leases, allocator: Allocator
) -> None:
    sent(leases)
    leases.forget_object("beam")
    assert leases.by_object == {} and "w" in leases.by_worker
    with pytest.raises(Refused) as refused:
        leases.match_answer(1, "w", 1)
    assert refused.value.kind == "epoch"
    assert leases.by_worker == {} and allocator.back == ["slot 1"]


def test_an_old_epoch_that_runs_out_or_is_lost_is_no_failure_of_the_new(leases: Leases) -> None:
    sent(leases, deadline=1.0)
    leases.forget_object("beam")
    new = sent(leases, worker="x", deadline=9.0, epoch=2)
    assert leases.expire(2.0) == []
    assert leases.remove_worker("w") == []
    assert leases.by_object == {"beam": new}


def test_leases_follow_the_last_factorization_and_double_when_missed(leases: Leases) -> None:
    assert leases.terms.lease("beam", "w") == MAX_LEASE, "whoever is asked first may have to compile"
    leases.finish(sent(leases), 0.4)
    assert leases.terms.lease("beam", "w") == pytest.approx(8.0)
    for _ in range(2):
        sent(leases, deadline=0.0)
        leases.expire(1.0)
    assert leases.terms.lease("beam", "w") == pytest.approx(32.0)
    for _ in range(20):
        sent(leases, deadline=0.0)
        leases.expire(1.0)
    assert leases.terms.lease("beam", "w") == MAX_LEASE
    leases.finish(sent(leases), 0.1)
    assert leases.terms.lease("beam", "w") == MIN_LEASE


def test_the_first_job_that_a_worker_assembles_may_take_its_time(leases: Leases) -> None:
    """It imports and compiles for that, though it has made factors of matrices; so may one by another method."""
    leases.finish(sent(leases), 0.01)
    assert leases.terms.lease("beam", "w") == MIN_LEASE
    assert leases.terms.lease("beam", "w", positions=True) == leases.terms.lease("beam", "w", "incomplete") == MAX_LEASE
    leases.finish(sent(leases, positions=True), 0.01)
    assert leases.terms.lease("beam", "w", positions=True) == MIN_LEASE


@pytest.mark.parametrize("method", ["cholesky", "incomplete"])
def test_the_terms_of_many_jobs_are_those_of_each_alone(leases: Leases, method: str) -> None:
    for seconds in (0.001, 0.4, 100.0):
        leases.finish(sent(leases, f"after {seconds}"), seconds)
    leases.finish(sent(leases, "at two", worker="other"), 0.3)
    leases.finish(sent(leases, "at two"), 0.9)
    leases.finish(sent(leases, "elsewhere", worker="other"), 0.3)
    leases.finish(sent(leases, "late"), 0.4)
    sent(leases, "late", deadline=0.0)
    leases.expire(1.0)
    names = ["after 0.001", "after 0.4", "after 100.0", "at two", "elsewhere", "late", "new"]
    leases_, periods = leases.terms.of_all(names, [40_000] * len(names), "w", method)
    found = leases_.tolist(), periods.tolist()
    expected = [leases.terms.lease(name, "w", method) for name in names]
    assert found == (expected, [leases.terms.exclusive_period(name, 40_000) for name in names])
    assert len(set(expected)) == (1 if method == "incomplete" else 5)


def test_who_is_late_costs_others_no_time(leases: Leases) -> None:
    """Leases are of an object at a worker."""
    leases.finish(sent(leases, worker="good"), 0.4)
    for _ in range(5):
        sent(leases, worker="bad", deadline=0.0)
        leases.expire(1.0)
    assert leases.terms.lease("beam", "good") == pytest.approx(8.0)
    leases.finish(sent(leases, worker="slow"), 4.0)
    assert (leases.terms.lease("beam", "good"), leases.terms.lease("beam", "slow")) == (
        pytest.approx(8.0),
        pytest.approx(80.0),
    )
    leases.remove_worker("good")
    leases.forget_object("beam")
    assert leases.terms.lease("beam", "slow") == MAX_LEASE


def test_an_object_waits_for_a_slow_worker_only_while_there_is_no_other(leases: Leases, allocator: Allocator) -> None:
    assert leases.terms.exclusive_period("beam", 10) == MIN_LEASE
    assert leases.terms.exclusive_period("beam", 100_000) == pytest.approx(10.0)
    leases.finish(sent(leases, worker="good"), 0.4)
    leases.finish(sent(leases, worker="slow"), 40.0)
    assert leases.terms.exclusive_period("beam", 10) == pytest.approx(8.0), "as long as the fastest might take"
    slow = sent(leases, worker="slow", deadline=99.0)  # exclusive until 0
    assert leases.reassign(0.1, lambda job: False) == [] and leases.by_object == {"beam": slow}
    assert leases.reassign(0.1, lambda job: True) == [slow]
    assert leases.by_object == {} and leases.jobs == [slow], "it is busy"
    other = sent(leases, worker="good", deadline=99.0)
    assert leases.match_answer(slow.number, "slow", 1) is slow and leases.is_reassigned(slow)
    leases.finish(slow, 50.0)
    assert leases.by_object == {"beam": other} and leases.jobs == [other]
    assert not leases.is_reassigned(slow)
    assert len(allocator.back) == 3


def test_a_job_that_was_never_sent_leaves_no_trace(leases: Leases, allocator: Allocator) -> None:
    leases.cancel(sent(leases).batch)
    assert (leases.by_object, leases.by_worker, allocator.back) == ({}, {}, ["slot 1"])


def test_a_job_is_lost_when_its_worker_keeps_saying_that_it_has_none(leases: Leases, allocator: Allocator) -> None:
    def undelivered(left: float, idle: tuple[float, float] | None) -> list[InFlightJob]:
        return leases.expire_undelivered(lambda job: left, lambda worker: idle)

    first = sent(leases, deadline=MAX_LEASE)
    assert undelivered(5.0, None) == [], "it is busy"
    assert undelivered(5.0, (0.0, 5.9)) == [], "it may be on its way"
    assert undelivered(0.0, (5.0, 5.9)) == [], "it may have answered just now"
    assert undelivered(float("inf"), (0.0, 99.0)) == [], "it has not left yet"
    assert undelivered(5.0, (0.0, 6.1)) == [first]
    assert (leases.by_object, leases.by_worker, leases.expired_count("w"), allocator.back) == ({}, {}, 1, [])
    again = sent(leases, deadline=MAX_LEASE)
    assert undelivered(5.0, (0.0, 6.9)) == [] and undelivered(5.0, (0.0, 7.1)) == [again]


def test_bytes_may_be_on_their_way_for_longer(leases: Leases) -> None:
    some = sent(leases)
    assert leases.terms.delivery_time(some) == DELIVERY
    assert leases.terms.delivery_time(sent(leases, payload_bytes=2_000_000)) == pytest.approx(DELIVERY + 2)
    assert leases.terms.delivery_time(sent(leases, payload_bytes=1 << 30)) < DELIVERY + 5, (
        "the rest had gone when it left"
    )
