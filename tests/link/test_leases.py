# SPDX-License-Identifier: MIT
"""The books of jobs in flight, without a network."""

from dataclasses import replace

import pytest

from protocol import Refused
from sim_server.network.leases import DELIVERED, LONGEST, SHORTEST, InFlightJob, Leases


class SlotAllocator:
    def __init__(self) -> None:
        self.back: list[object] = []

    def give_back(self, slot: object) -> None:
        self.back.append(slot)


def flight(jobs: Leases, object: str = "beam", worker: str = "w", deadline: float = 2.0, epoch: int = 1) -> InFlightJob:
    number = jobs.next_number()
    started = InFlightJob(number, object, epoch, 1, True, "float32", worker, deadline, slots=(f"slot {number}",))  # type: ignore[arg-type]
    jobs.start(started)
    return started


@pytest.fixture
def lender() -> SlotAllocator:
    return SlotAllocator()


@pytest.fixture
def jobs(lender: SlotAllocator) -> Leases:
    return Leases(lender)


def test_an_answer_frees_object_worker_and_slots(jobs: Leases, lender: SlotAllocator) -> None:
    first = flight(jobs)
    assert jobs.answered(1, "w", 1) is first
    jobs.end(first, 0.5)
    assert (jobs.by_object, jobs.by_worker, lender.back) == ({}, {}, ["slot 1"])
    with pytest.raises(Refused, match="already answered") as refused:
        jobs.answered(1, "w", 1)
    assert refused.value.kind == "duplicate"


@pytest.mark.parametrize(
    ("number", "worker", "epoch", "kind"),
    [(2, "w", 1, "sequence"), (0, "w", 1, "sequence"), (1, "x", 1, "duplicate"), (1, "w", 2, "epoch")],
)
def test_answers_to_nothing_leave_the_job_alone(jobs: Leases, number: int, worker: str, epoch: int, kind: str) -> None:
    first = flight(jobs)
    with pytest.raises(Refused) as refused:
        jobs.answered(number, worker, epoch)
    assert refused.value.kind == kind
    assert jobs.by_object == {"beam": first} and jobs.by_worker == {"w": first}


def test_a_lease_that_ends_frees_object_and_worker_but_not_the_slots(jobs: Leases, lender: SlotAllocator) -> None:
    first = flight(jobs, deadline=2.0)
    assert jobs.expire(1.9) == []
    assert jobs.expire(2.1) == [first]
    assert (jobs.by_object, jobs.by_worker, lender.back, jobs.lateness("w")) == ({}, {}, [], 1)
    with pytest.raises(Refused) as refused:
        jobs.answered(1, "w", 1)
    assert refused.value.kind == "late"
    assert lender.back == ["slot 1"] and jobs.lateness("w") == 0


def test_an_answer_to_a_later_job_frees_the_slots_of_late_ones(jobs: Leases, lender: SlotAllocator) -> None:
    flight(jobs, deadline=1.0)
    jobs.expire(2.0)
    second = flight(jobs, deadline=3.0)
    jobs.end(jobs.answered(second.number, "w", 1))
    assert sorted(map(str, lender.back)) == ["slot 1", "slot 2"]


def test_leaving_frees_everything_of_the_worker(jobs: Leases, lender: SlotAllocator) -> None:
    flight(jobs, deadline=1.0)
    jobs.expire(2.0)
    second = flight(jobs, deadline=9.0)
    other = flight(jobs, object="liver", worker="x")
    assert jobs.lost("w") is second
    assert sorted(map(str, lender.back)) == ["slot 1", "slot 2"]
    assert jobs.by_object == {"liver": other} and jobs.lost("w") is None


def test_a_new_epoch_frees_the_object_at_once_and_the_worker_when_it_answers(
    jobs: Leases, lender: SlotAllocator
) -> None:
    flight(jobs)
    jobs.forget("beam")
    assert jobs.by_object == {} and "w" in jobs.by_worker
    with pytest.raises(Refused) as refused:
        jobs.answered(1, "w", 1)
    assert refused.value.kind == "epoch"
    assert jobs.by_worker == {} and lender.back == ["slot 1"]


def test_an_old_epoch_that_runs_out_or_is_lost_is_no_failure_of_the_new(jobs: Leases) -> None:
    flight(jobs, deadline=1.0)
    jobs.forget("beam")
    new = flight(jobs, worker="x", deadline=9.0, epoch=2)
    assert jobs.expire(2.0) == []
    assert jobs.lost("w") is None
    assert jobs.by_object == {"beam": new}


def test_leases_follow_the_last_factorization_and_double_when_missed(jobs: Leases) -> None:
    assert jobs.lease("beam", "w") == LONGEST, "whoever is asked first may have to compile"
    jobs.end(flight(jobs), 0.4)
    assert jobs.lease("beam", "w") == pytest.approx(8.0)
    for _ in range(2):
        flight(jobs, deadline=0.0)
        jobs.expire(1.0)
    assert jobs.lease("beam", "w") == pytest.approx(32.0)
    for _ in range(20):
        flight(jobs, deadline=0.0)
        jobs.expire(1.0)
    assert jobs.lease("beam", "w") == LONGEST
    jobs.end(flight(jobs), 0.1)
    assert jobs.lease("beam", "w") == SHORTEST


def test_who_is_late_costs_others_no_time(jobs: Leases) -> None:
    """Leases are of an object at a worker."""
    jobs.end(flight(jobs, worker="good"), 0.4)
    for _ in range(5):
        flight(jobs, worker="bad", deadline=0.0)
        jobs.expire(1.0)
    assert jobs.lease("beam", "good") == pytest.approx(8.0)
    jobs.end(flight(jobs, worker="slow"), 4.0)
    assert (jobs.lease("beam", "good"), jobs.lease("beam", "slow")) == (pytest.approx(8.0), pytest.approx(80.0))
    jobs.lost("good")
    jobs.forget("beam")
    assert jobs.lease("beam", "slow") == LONGEST


def test_an_object_waits_for_a_slow_worker_only_while_there_is_no_other(jobs: Leases, lender: SlotAllocator) -> None:
    assert jobs.alone("beam", 10) == SHORTEST and jobs.alone("beam", 100_000) == pytest.approx(10.0)
    jobs.end(flight(jobs, worker="good"), 0.4)
    jobs.end(flight(jobs, worker="slow"), 40.0)
    assert jobs.alone("beam", 10) == pytest.approx(8.0), "as long as the fastest might take"
    slow = flight(jobs, worker="slow", deadline=99.0)  # alone until 0
    assert jobs.pass_on(0.1, lambda flight: False) == [] and jobs.by_object == {"beam": slow}
    assert jobs.pass_on(0.1, lambda flight: True) == [slow]
    assert jobs.by_object == {} and jobs.by_worker == {"slow": slow}, "it is busy"
    other = flight(jobs, worker="good", deadline=99.0)
    assert jobs.answered(slow.number, "slow", 1) is slow and jobs.passed(slow)
    jobs.end(slow, 50.0)
    assert jobs.by_object == {"beam": other} and jobs.by_worker == {"good": other} and not jobs.passed(slow)
    assert len(lender.back) == 3


def test_a_job_that_was_never_sent_leaves_no_trace(jobs: Leases, lender: SlotAllocator) -> None:
    jobs.cancel(flight(jobs))
    assert (jobs.by_object, jobs.by_worker, lender.back) == ({}, {}, ["slot 1"])


def test_a_job_is_lost_when_its_worker_keeps_saying_that_it_has_none(jobs: Leases, lender: SlotAllocator) -> None:
    def undelivered(left: float, idle: tuple[float, float] | None) -> list[InFlightJob]:
        return jobs.undelivered(lambda flight: left, lambda worker: idle)

    first = flight(jobs, deadline=LONGEST)
    assert undelivered(5.0, None) == [], "it is busy"
    assert undelivered(5.0, (0.0, 5.9)) == [], "it may be on its way"
    assert undelivered(0.0, (5.0, 5.9)) == [], "it may have answered just now"
    assert undelivered(float("inf"), (0.0, 99.0)) == [], "it has not left yet"
    assert undelivered(5.0, (0.0, 6.1)) == [first]
    assert (jobs.by_object, jobs.by_worker, jobs.lateness("w"), lender.back) == ({}, {}, 1, [])
    again = flight(jobs, deadline=LONGEST)
    assert undelivered(5.0, (0.0, 6.9)) == [] and undelivered(5.0, (0.0, 7.1)) == [again]


def test_bytes_may_be_on_their_way_for_longer(jobs: Leases) -> None:
    some = flight(jobs)
    assert jobs.delivery(some) == DELIVERED
    assert jobs.delivery(replace(some, bytes=2_000_000)) == pytest.approx(DELIVERED + 2)
    assert jobs.delivery(replace(some, bytes=1 << 30)) < DELIVERED + 5, "the rest had gone when it left"
