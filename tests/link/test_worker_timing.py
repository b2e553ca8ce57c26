# SPDX-License-Identifier: MIT
"""Expected times of workers of different speed, and the faster busy workers that are worth waiting for."""

import math

import pytest

from sim_server.network.worker_timing import FIRST_JOB, HANGING, MAX_SLOWNESS, WorkerTiming


@pytest.fixture
def timing() -> WorkerTiming:
    """Two objects; the slow worker takes ten times as long as the fast one."""
    timing = WorkerTiming()
    for _ in range(5):
        for object, seconds in (("small", 0.1), ("large", 1.0)):
            timing.record("fast", object, seconds)
            timing.record("slow", object, 10 * seconds)
    return timing


def test_speeds_are_ratios_of_the_same_objects(timing: WorkerTiming) -> None:
    assert timing.slowness("fast") == pytest.approx(1) and timing.slowness("slow") == pytest.approx(10)
    assert timing.expected("slow", "large") == pytest.approx(10)
    timing.record("fast", "new", 0.2)
    assert timing.expected("slow", "new") == pytest.approx(FIRST_JOB * 10 * 0.2)
    assert timing.expected("fast", "unknown") == 0


def test_a_worker_alone_with_its_objects_is_compared_with_nobody() -> None:
    timing = WorkerTiming()
    for seconds in (9.0, 1.0, 5.0):
        timing.record("alone", "beam", seconds)
    assert timing.slowness("alone") == 1
    assert timing.expected("new", "beam") == 0, "tried, to be compared"


def test_what_is_believed_is_bounded() -> None:
    timing = WorkerTiming()
    timing.record("a", "beam", 1e-6)
    timing.record("b", "beam", 1e6)
    assert timing.slowness("b") == MAX_SLOWNESS
    timing.record("c", "liver", 0.0)
    timing.record("d", "liver", 0.0)
    assert timing.slowness("d") == 1


@pytest.mark.parametrize(
    ("idle", "elapsed", "faster"),
    [
        (["slow"], 0.0, 1),  # 1 s for what it has, 0.55 s for the next: less than the 5.5 s of the slow one
        (["slow"], 0.9, 1),
        (["slow"], HANGING * 1.0 + 0.1, 0),  # it hangs
        (["fast2"], 0.9, 0),  # nobody waits for a worker of the same speed
        (["slow", "fast2"], 0.9, 0),
        ([], 0.9, 0),
    ],
)
def test_the_most_urgent_object_waits_for_a_faster_worker_about_to_be_free(
    timing: WorkerTiming, idle: list[str], elapsed: float, faster: int
) -> None:
    assert timing.faster_busy_workers([(worker, 0.1) for worker in idle], [("fast", "large", elapsed)]) == faster


def test_nobody_idles_longer_than_a_job_takes(timing: WorkerTiming) -> None:
    busy = [("fast", "large", 0.5)]
    assert timing.faster_busy_workers([("slow", 5.4)], busy) == 1
    assert timing.faster_busy_workers([("slow", 5.6)], busy) == 0


def test_as_many_objects_are_left_as_there_are_faster_workers(timing: WorkerTiming) -> None:
    timing.record("other", "small", 0.1)
    busy = [("fast", "small", 0.05), ("other", "small", 0.05), ("slow", "small", 0.05)]
    assert timing.faster_busy_workers([("slow2", 0.0)], busy) == 0, "of slow2 nothing is known: it counts as fast"
    timing.record("slow2", "small", 1.0)
    assert timing.faster_busy_workers([("slow2", 0.0)], busy) == 2


def test_those_who_left_are_forgotten(timing: WorkerTiming) -> None:
    timing.forget_worker("slow")
    assert timing.slowness("slow") == 1
    timing.forget_object("large")
    assert timing.expected("fast", "large") == 0
    assert timing.faster_busy_workers([("fast", 0.0)], [("fast", "small", math.inf)]) == 0
    assert WorkerTiming().faster_busy_workers([("fast", 0.0)], [("slow", "small", 0.0)]) == 0


def test_an_analysis_counts_not() -> None:
    timing = WorkerTiming()
    timing.record("w", "beam", 5.0, 0.5)
    assert timing.expected("w", "beam") == 0.5
    timing.record("w", "beam", 1.5, 0.5)
    assert timing.expected("w", "beam") == pytest.approx(0.8)
    timing.record("x", "beam", 0.1, 1e9)
    assert timing.expected("x", "beam") == 0.1, "no more is believed than was seen"
