# SPDX-License-Identifier: MIT
"""An attempt repeated at growing intervals until it succeeds."""

import threading

from precond_worker.network.retry import ATTEMPTS, Retry

PATIENCE = 30.0  # s


def test_it_is_repeated_until_it_succeeds() -> None:
    again, answers, done = Retry(1e-4), iter([False, False, True]), threading.Event()
    again.start(lambda: next(answers), done.set)
    assert done.wait(PATIENCE)
    again.close()
    assert list(answers) == []


def test_it_is_not_repeated_for_ever() -> None:
    again, asked, called = Retry(1e-5), [], []
    again.start(lambda: bool(asked.append(1)), lambda: called.append(1))
    assert again._thread is not None
    again._thread.join(PATIENCE)
    assert len(asked) == ATTEMPTS and not called


def test_an_attempt_that_was_replaced_or_stopped_has_no_effect() -> None:
    again, asking, go_on, called = Retry(1e-4), threading.Event(), threading.Event(), []

    def slow() -> bool:
        asking.set()
        return go_on.wait(PATIENCE)

    again.start(slow, lambda: called.append("old"))
    assert asking.wait(PATIENCE)
    old, done = again._thread, threading.Event()
    again.start(lambda: True, done.set)
    assert done.wait(PATIENCE)
    go_on.set()
    assert old is not None
    old.join(PATIENCE)
    again.close()
    assert called == []
