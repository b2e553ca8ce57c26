# SPDX-License-Identifier: MIT
"""Sending without waiting."""

import threading

import zenoh

from sim_server.network.outbox import Outbox


def test_everything_is_sent_in_order_and_errors_stop_nothing() -> None:
    sent, done = [], threading.Event()

    def fail() -> None:
        raise zenoh.ZError("gone")

    outbox = Outbox("test", 10)
    outbox.post(lambda: sent.append(1))
    outbox.post(fail)
    outbox.post(lambda: sent.append(2))
    outbox.post(done.set)
    assert done.wait(10)
    assert sent == [1, 2]
    outbox.close()
    assert not outbox.post(lambda: sent.append(3))


def test_a_stuck_send_blocks_no_sender_and_newer_replaces_older() -> None:
    stuck, sent, done = threading.Event(), [], threading.Event()
    begun = threading.Event()

    def block() -> None:
        begun.set()
        stuck.wait(10)

    outbox = Outbox("test", 3)
    outbox.post(block)
    assert begun.wait(10)
    assert outbox.post(lambda: sent.append("old"), "state")
    assert not outbox.post(lambda: sent.append("new"), "state")  # the older one was dropped
    assert outbox.post(lambda: sent.append("other"))
    assert outbox.post(done.set)
    assert not outbox.post(lambda: sent.append("too many"))
    stuck.set()
    assert done.wait(10)
    assert sent == ["new", "other"]
    outbox.close()
