# SPDX-License-Identifier: MIT
"""Sending without waiting."""

import threading

import zenoh

from sim_server.network.send_queue import SendQueue


def test_everything_is_sent_in_order_and_errors_stop_nothing() -> None:
    sent, done = [], threading.Event()

    def fail() -> None:
        raise zenoh.ZError("gone")

    queue = SendQueue("test", 10)
    queue.post(lambda: sent.append(1))
    queue.post(fail)
    queue.post(lambda: sent.append(2))
    queue.post(done.set)
    assert done.wait(10)
    assert sent == [1, 2]
    queue.close()
    assert not queue.post(lambda: sent.append(3))


def test_a_stuck_send_blocks_no_sender_and_newer_replaces_older() -> None:
    stuck, sent, done = threading.Event(), [], threading.Event()
    begun = threading.Event()

    def block() -> None:
        begun.set()
        stuck.wait(10)

    queue = SendQueue("test", 3)
    queue.post(block)
    assert begun.wait(10)
    assert queue.post(lambda: sent.append("old"), "state")
    assert not queue.post(lambda: sent.append("new"), "state")  # the older one was dropped
    assert queue.post(lambda: sent.append("other"))
    assert queue.post(done.set)
    assert not queue.post(lambda: sent.append("too many"))
    stuck.set()
    assert done.wait(10)
    assert sent == ["new", "other"]
    queue.close()


def test_closing_may_send_what_waits() -> None:
    sent: list[int] = []
    begun, go_on = threading.Event(), threading.Event()
    queue = SendQueue("test", 10)
    queue.post(lambda: (begun.set(), go_on.wait(5)))  # type: ignore[arg-type,return-value]
    begun.wait(5)
    for k in range(5):
        queue.post(lambda k=k: sent.append(k))  # type: ignore[misc]
    threading.Timer(0.05, go_on.set).start()
    queue.close(timeout=5, finish=True)
    assert sent == list(range(5)) and not queue.post(lambda: None)
