# SPDX-License-Identifier: MIT
"""A question asked again, with pauses that grow, until the answer is yes."""

import threading

from precond_worker.again import TIMES, Again

PATIENCE = 30.0  # s


def test_it_is_asked_until_the_answer_is_yes() -> None:
    again, answers, done = Again(1e-4), iter([False, False, True]), threading.Event()
    again.ask(lambda: next(answers), done.set)
    assert done.wait(PATIENCE)
    again.close()
    assert list(answers) == []


def test_it_is_not_asked_for_ever() -> None:
    again, asked, called = Again(1e-5), [], []
    again.ask(lambda: bool(asked.append(1)), lambda: called.append(1))
    assert again._thread is not None
    again._thread.join(PATIENCE)
    assert len(asked) == TIMES and not called


def test_what_is_asked_in_its_place_or_stopped_has_no_effect_any_more() -> None:
    again, asking, go_on, called = Again(1e-4), threading.Event(), threading.Event(), []

    def slow() -> bool:
        asking.set()
        return go_on.wait(PATIENCE)

    again.ask(slow, lambda: called.append("old"))
    assert asking.wait(PATIENCE)
    old, done = again._thread, threading.Event()
    again.ask(lambda: True, done.set)
    assert done.wait(PATIENCE)
    go_on.set()
    assert old is not None
    old.join(PATIENCE)
    again.close()
    assert called == []
