# SPDX-License-Identifier: MIT
"""Who gets jobs at all: those who answer, newcomers a few at a time, and nobody whose factors come to nothing."""

from sim_server.network.worker_reliability import GAP, HOLD, MOST, WorkerReliability


def may_be_asked(conduct: WorkerReliability, fit: list[str], now: float) -> list[str]:
    return [name for name in fit if conduct.may_be_asked(name, fit, now)]


def test_while_nobody_has_answered_all_are_asked() -> None:
    conduct, fit = WorkerReliability(), ["a", "b", "c"]
    for name in fit:
        assert may_be_asked(conduct, fit, 0.0) == fit
        conduct.sent(name, 0.0)
    assert may_be_asked(conduct, fit, 100.0) == fit, "there is nobody better"


def test_beside_one_who_answers_newcomers_are_tried_one_at_a_time() -> None:
    conduct = WorkerReliability()
    fakes = [f"fake{k}" for k in range(20)]
    fit = ["real", *fakes]
    conduct.sent("real", 0.0)
    conduct.answered("real")
    asked = 0
    for tenth in range(3000):
        now = 0.1 * tenth
        for name in fakes:
            if conduct.may_be_asked(name, fit, now):
                conduct.sent(name, now)
                asked += 1
        assert "real" in may_be_asked(conduct, fit, now)
    assert 1 <= asked <= 5, "each that does not answer doubles the time to the next"
    assert len(may_be_asked(conduct, fit, 0.1 + GAP * 2**9)) == 1 + len(fakes) - asked


def test_as_many_newcomers_are_tried_as_have_answered() -> None:
    conduct, fit = WorkerReliability(), [f"w{k}" for k in range(8)]
    conduct.answered("w0")
    new, counts = fit[1:], []
    while new:
        tried = []
        while new and conduct.may_be_asked(new[0], fit, 0.0):
            conduct.sent(new[0], 0.0)
            tried.append(new.pop(0))
        counts.append(len(tried))
        for name in tried:
            conduct.answered(name)
    assert counts == [1, 2, 4]


def test_who_sends_what_is_no_use_is_asked_less_and_less_of_that_object() -> None:
    conduct = WorkerReliability()
    held = []
    for count in range(1, MOST + 3):
        conduct.failed("bad", "beam", 0.0)
        length = HOLD * 2 ** min(count, MOST)
        assert conduct.held("bad", "beam", 0.99 * length) and not conduct.held("bad", "beam", 1.01 * length)
        held.append(length)
    assert held == sorted(held) and held[-1] < 60
    assert not conduct.held("good", "beam", 0.0) and not conduct.held("bad", "liver", 0.0)
    assert conduct.failures(["bad", "good"], "beam") == 0, "while one of them is good the object is not held back"
    assert conduct.failures(["bad"], "beam") == MOST + 2 and conduct.failing == {"beam"}
    conduct.helped("bad", "beam")
    assert not conduct.held("bad", "beam", 0.0) and not conduct.failing


def test_those_who_left_and_objects_that_changed_are_forgotten() -> None:
    conduct = WorkerReliability()
    conduct.answered("good")
    conduct.sent("new", 0.0)
    for worker in ("good", "new"):
        conduct.failed(worker, "beam", 0.0)
    conduct.forget_worker("new")
    assert conduct.may_be_asked("new", ["good", "new"], 0.0) and not conduct.held("new", "beam", 0.0)
    conduct.forget_object("beam")
    assert not conduct.failing
    conduct.forget_worker("good")
    conduct.sent("new", 0.0)
    assert conduct.may_be_asked("new", ["good", "new"], 0.0), "nobody is known any more"
