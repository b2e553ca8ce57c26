# SPDX-License-Identifier: MIT
"""An attempt repeated at growing intervals until it succeeds."""

import threading

from precond_worker.network.retry import ATTEMPTS, Retry

PATIENCE = 30.0  # s


def wait_for_threads() -> None:
    """Until no attempt is under way, replaced ones included."""
    for thread in threading.enumerate():
        if thread.name == "retry":
            thread.join(PATIENCE)
            assert not thread.is_alive()


def test_it_is_repeated_until_it_succeeds() -> None:
    again, answers, done = Retry(1e-4), iter([False, False, True]), threading.Event()
    again.start(lambda: next(answers), done.set)
    assert done.wait(PATIENCE)
    again.close()
    assert list(answers) == []


def test_it_is_not_repeated_for_ever() -> None:
    again, asked, called = Retry(1e-5), [], []
    again.start(lambda: bool(asked.append(1)), lambda: called.append(1))
    wait_for_threads()
    assert len(asked) == ATTEMPTS and not called


def test_an_attempt_that_was_replaced_or_stopped_has_no_effect() -> None:
    again, asking, go_on, called = Retry(1e-4), threading.Event(), threading.Event(), []

    def slow() -> bool:
        asking.set()
        return go_on.wait(PATIENCE)

    again.start(slow, lambda: called.append("old"))
    assert asking.wait(PATIENCE)
    done = threading.Event()
    again.start(lambda: True, done.set)
    assert done.wait(PATIENCE)
    go_on.set()
    wait_for_threads()
    again.close()
    assert called == []
