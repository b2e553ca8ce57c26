# SPDX-License-Identifier: MIT
"""Workers of different speed: what is expected of them and whom the most urgent object waits for."""

import math

import pytest

from sim_server.network.worker_timing import FIRST, HANGS, SLOWEST, WorkerTiming


@pytest.fixture
def speeds() -> WorkerTiming:
    """Two objects; the slow worker takes ten times as long as the fast one."""
    speeds = WorkerTiming()
    for _ in range(5):
        for object, seconds in (("small", 0.1), ("large", 1.0)):
            speeds.note("fast", object, seconds)
            speeds.note("slow", object, 10 * seconds)
    return speeds


def test_speeds_are_ratios_of_the_same_objects(speeds: WorkerTiming) -> None:
    assert speeds.slowness("fast") == pytest.approx(1) and speeds.slowness("slow") == pytest.approx(10)
    assert speeds.expected("slow", "large") == pytest.approx(10)
    speeds.note("fast", "new", 0.2)
    assert speeds.expected("slow", "new") == pytest.approx(FIRST * 10 * 0.2)
    assert speeds.expected("fast", "unknown") == 0


def test_a_worker_alone_with_its_objects_is_compared_with_nobody() -> None:
    speeds = WorkerTiming()
    for seconds in (9.0, 1.0, 5.0):
        speeds.note("alone", "beam", seconds)
    assert speeds.slowness("alone") == 1
    assert speeds.expected("new", "beam") == 0, "tried, to be compared"


def test_what_is_believed_is_bounded() -> None:
    speeds = WorkerTiming()
    speeds.note("a", "beam", 1e-6)
    speeds.note("b", "beam", 1e6)
    assert speeds.slowness("b") == SLOWEST
    speeds.note("c", "liver", 0.0)
    speeds.note("d", "liver", 0.0)
    assert speeds.slowness("d") == 1


@pytest.mark.parametrize(
    ("idle", "elapsed", "ahead"),
    [
        (["slow"], 0.0, 1),  # 1 s for what it has, 0.55 s for the next: less than the 5.5 s of the slow one
        (["slow"], 0.9, 1),
        (["slow"], HANGS * 1.0 + 0.1, 0),  # it hangs
        (["fast2"], 0.9, 0),  # nobody waits for a worker of the same speed
        (["slow", "fast2"], 0.9, 0),
        ([], 0.9, 0),
    ],
)
def test_the_most_urgent_object_waits_for_a_faster_worker_about_to_be_free(
    speeds: WorkerTiming, idle: list[str], elapsed: float, ahead: int
) -> None:
    assert speeds.ahead([(worker, 0.1) for worker in idle], [("fast", "large", elapsed)]) == ahead


def test_nobody_idles_longer_than_a_job_takes(speeds: WorkerTiming) -> None:
    busy = [("fast", "large", 0.5)]
    assert speeds.ahead([("slow", 5.4)], busy) == 1
    assert speeds.ahead([("slow", 5.6)], busy) == 0


def test_as_many_objects_are_left_as_there_are_faster_workers(speeds: WorkerTiming) -> None:
    speeds.note("other", "small", 0.1)
    busy = [("fast", "small", 0.05), ("other", "small", 0.05), ("slow", "small", 0.05)]
    assert speeds.ahead([("slow2", 0.0)], busy) == 0, "of slow2 nothing is known: it counts as fast"
    speeds.note("slow2", "small", 1.0)
    assert speeds.ahead([("slow2", 0.0)], busy) == 2


def test_those_who_left_are_forgotten(speeds: WorkerTiming) -> None:
    speeds.forget_worker("slow")
    assert speeds.slowness("slow") == 1
    speeds.forget_object("large")
    assert speeds.expected("fast", "large") == 0
    assert speeds.ahead([("fast", 0.0)], [("fast", "small", math.inf)]) == 0
    assert WorkerTiming().ahead([("fast", 0.0)], [("slow", "small", 0.0)]) == 0


def test_an_analysis_counts_not() -> None:
    speeds = WorkerTiming()
    speeds.note("w", "beam", 5.0, 0.5)
    assert speeds.expected("w", "beam") == 0.5
    speeds.note("w", "beam", 1.5, 0.5)
    assert speeds.expected("w", "beam") == pytest.approx(0.8)
    speeds.note("x", "beam", 0.1, 1e9)
    assert speeds.expected("x", "beam") == 0.1, "no more is believed than was seen"
