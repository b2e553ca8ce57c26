# SPDX-License-Identifier: MIT
"""The first signal waits until what is under way is over, a second one does not."""

import signal
import threading
from collections.abc import Iterator

import pytest

from protocol.process.command_line import Terminated, end_in_order, held_signals


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    end_in_order()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_the_first_waits_until_the_end():
    done = False
    with pytest.raises(Terminated), held_signals() as waits:
        assert not waits()
        signal.raise_signal(signal.SIGTERM)
        done = waits()
    assert done
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_second_one_acts_at_once():
    with pytest.raises(KeyboardInterrupt), held_signals():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it goes on")


def test_an_error_is_told_before_a_signal():
    with pytest.raises(ValueError, match="it failed"), held_signals():
        signal.raise_signal(signal.SIGTERM)
        raise ValueError("it failed")


def test_another_thread_holds_none():
    """It does not get them: the main thread, where they act, goes on as if it were not there."""
    entered, leave = threading.Event(), threading.Event()

    def work() -> None:
        with held_signals():
            entered.set()
            leave.wait()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        entered.wait()
        with pytest.raises(Terminated):
            signal.raise_signal(signal.SIGTERM)
    finally:
        leave.set()
        thread.join()
