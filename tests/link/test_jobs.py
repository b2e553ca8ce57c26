# SPDX-License-Identifier: MIT
"""The books of jobs in flight, without a network."""

import pytest

from protocol import Refused
from sim_server.network.jobs import LONGEST, SHORTEST, Flight, Jobs


class Lender:
    def __init__(self) -> None:
        self.back: list[object] = []

    def give_back(self, slot: object) -> None:
        self.back.append(slot)


def flight(jobs: Jobs, object: str = "beam", worker: str = "w", deadline: float = 2.0, epoch: int = 1) -> Flight:
    number = jobs.next_number()
    started = Flight(number, object, epoch, 1, True, "float32", worker, deadline, slots=(f"slot {number}",))  # type: ignore[arg-type]
    jobs.start(started)
    return started


@pytest.fixture
def lender() -> Lender:
    return Lender()


@pytest.fixture
def jobs(lender: Lender) -> Jobs:
    return Jobs(lender)


def test_an_answer_frees_object_worker_and_slots(jobs: Jobs, lender: Lender) -> None:
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
def test_answers_to_nothing_leave_the_job_alone(jobs: Jobs, number: int, worker: str, epoch: int, kind: str) -> None:
    first = flight(jobs)
    with pytest.raises(Refused) as refused:
        jobs.answered(number, worker, epoch)
    assert refused.value.kind == kind
    assert jobs.by_object == {"beam": first} and jobs.by_worker == {"w": first}


def test_a_lease_that_ends_frees_object_and_worker_but_not_the_slots(jobs: Jobs, lender: Lender) -> None:
    first = flight(jobs, deadline=2.0)
    assert jobs.expire(1.9) == []
    assert jobs.expire(2.1) == [first]
    assert (jobs.by_object, jobs.by_worker, lender.back, jobs.lateness("w")) == ({}, {}, [], 1)
    with pytest.raises(Refused) as refused:
        jobs.answered(1, "w", 1)
    assert refused.value.kind == "late"
    assert lender.back == ["slot 1"] and jobs.lateness("w") == 0


def test_an_answer_to_a_later_job_frees_the_slots_of_late_ones(jobs: Jobs, lender: Lender) -> None:
    flight(jobs, deadline=1.0)
    jobs.expire(2.0)
    second = flight(jobs, deadline=3.0)
    jobs.end(jobs.answered(second.number, "w", 1))
    assert sorted(map(str, lender.back)) == ["slot 1", "slot 2"]


def test_leaving_frees_everything_of_the_worker(jobs: Jobs, lender: Lender) -> None:
    flight(jobs, deadline=1.0)
    jobs.expire(2.0)
    second = flight(jobs, deadline=9.0)
    other = flight(jobs, object="liver", worker="x")
    assert jobs.lost("w") is second
    assert sorted(map(str, lender.back)) == ["slot 1", "slot 2"]
    assert jobs.by_object == {"liver": other} and jobs.lost("w") is None


def test_a_new_epoch_frees_the_object_at_once_and_the_worker_when_it_answers(jobs: Jobs, lender: Lender) -> None:
    flight(jobs)
    jobs.forget("beam")
    assert jobs.by_object == {} and "w" in jobs.by_worker
    with pytest.raises(Refused) as refused:
        jobs.answered(1, "w", 1)
    assert refused.value.kind == "epoch"
    assert jobs.by_worker == {} and lender.back == ["slot 1"]


def test_an_old_epoch_that_runs_out_or_is_lost_is_no_failure_of_the_new(jobs: Jobs) -> None:
    flight(jobs, deadline=1.0)
    jobs.forget("beam")
    new = flight(jobs, worker="x", deadline=9.0, epoch=2)
    assert jobs.expire(2.0) == []
    assert jobs.lost("w") is None
    assert jobs.by_object == {"beam": new}


def test_leases_follow_the_last_factorization_and_double_when_missed(jobs: Jobs) -> None:
    assert jobs.lease("beam", 10) == SHORTEST
    assert jobs.lease("beam", 100_000) == pytest.approx(10.0)
    first = flight(jobs)
    jobs.end(first, 0.4)
    assert jobs.lease("beam", 10) == pytest.approx(8.0)
    for _ in range(2):
        flight(jobs, deadline=0.0)
        jobs.expire(1.0)
    assert jobs.lease("beam", 10) == pytest.approx(32.0)
    for _ in range(20):
        flight(jobs, deadline=0.0)
        jobs.expire(1.0)
    assert jobs.lease("beam", 10) == LONGEST
    jobs.end(flight(jobs), 0.1)
    assert jobs.lease("beam", 10) == pytest.approx(2.0)


def test_a_job_that_was_never_sent_leaves_no_trace(jobs: Jobs, lender: Lender) -> None:
    jobs.cancel(flight(jobs))
    assert (jobs.by_object, jobs.by_worker, lender.back) == ({}, {}, ["slot 1"])
