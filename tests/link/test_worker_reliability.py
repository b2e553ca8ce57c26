# SPDX-License-Identifier: MIT
"""Which workers may get jobs: those that answer, a few new ones at a time, none whose factors fail."""

from sim_server.network.worker_reliability import FIRST_ANSWER, MAX_SUSPENSION_DOUBLINGS, SUSPENSION, WorkerReliability


def may_get_job(reliability: WorkerReliability, available: list[str], now: float) -> list[str]:
    return [name for name in available if reliability.may_get_job(name, available, now)]


def test_while_nobody_has_answered_all_are_asked() -> None:
    reliability, available = WorkerReliability(), ["a", "b", "c"]
    for name in available:
        assert may_get_job(reliability, available, 0.0) == available
        reliability.on_sent(name, 0.0)
    assert may_get_job(reliability, available, 100.0) == available, "there is nobody better"


def test_beside_one_who_answers_newcomers_are_tried_one_at_a_time() -> None:
    reliability = WorkerReliability()
    fakes = [f"fake{k}" for k in range(20)]
    available = ["real", *fakes]
    reliability.on_sent("real", 0.0)
    reliability.on_answer("real")
    asked = 0
    for tenth in range(3000):
        now = 0.1 * tenth
        for name in fakes:
            if reliability.may_get_job(name, available, now):
                reliability.on_sent(name, now)
                asked += 1
        assert "real" in may_get_job(reliability, available, now)
    assert 1 <= asked <= 5, "each that does not answer doubles the time to the next"
    assert len(may_get_job(reliability, available, 0.1 + FIRST_ANSWER * 2**9)) == 1 + len(fakes) - asked


def test_as_many_newcomers_are_tried_as_have_answered() -> None:
    reliability, available = WorkerReliability(), [f"w{k}" for k in range(8)]
    reliability.on_answer("w0")
    new, counts = available[1:], []
    while new:
        tried = []
        while new and reliability.may_get_job(new[0], available, 0.0):
            reliability.on_sent(new[0], 0.0)
            tried.append(new.pop(0))
        counts.append(len(tried))
        for name in tried:
            reliability.on_answer(name)
    assert counts == [1, 2, 4]


def test_who_sends_what_is_no_use_is_asked_less_and_less_of_that_object() -> None:
    reliability = WorkerReliability()
    lengths = []
    for count in range(1, MAX_SUSPENSION_DOUBLINGS + 3):
        reliability.on_failure("bad", "beam", 0.0)
        length = SUSPENSION * 2 ** min(count, MAX_SUSPENSION_DOUBLINGS)
        assert reliability.is_suspended("bad", "beam", 0.99 * length)
        assert not reliability.is_suspended("bad", "beam", 1.01 * length)
        lengths.append(length)
    assert lengths == sorted(lengths) and lengths[-1] < 60
    assert not reliability.is_suspended("good", "beam", 0.0) and not reliability.is_suspended("bad", "liver", 0.0)
    assert reliability.consecutive_failures(["bad", "good"], "beam") == 0, "one of them is good"
    assert reliability.consecutive_failures(["bad"], "beam") == MAX_SUSPENSION_DOUBLINGS + 2
    assert reliability.failing_objects == {"beam"}
    reliability.on_success("bad", "beam")
    assert not reliability.is_suspended("bad", "beam", 0.0) and not reliability.failing_objects


def test_those_who_left_and_objects_that_changed_are_forgotten() -> None:
    reliability = WorkerReliability()
    reliability.on_answer("good")
    reliability.on_sent("new", 0.0)
    for worker in ("good", "new"):
        reliability.on_failure(worker, "beam", 0.0)
    reliability.forget_worker("new")
    assert reliability.may_get_job("new", ["good", "new"], 0.0) and not reliability.is_suspended("new", "beam", 0.0)
    reliability.forget_object("beam")
    assert not reliability.failing_objects
    reliability.forget_worker("good")
    reliability.on_sent("new", 0.0)
    assert reliability.may_get_job("new", ["good", "new"], 0.0), "nobody is known any more"
