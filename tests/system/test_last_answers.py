# SPDX-License-Identifier: MIT
"""Answers to several jobs that have come count, though no thread has taken them in yet when their jobs would end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread

import pytest
from hand_worker import HandWorker
from link_helpers import Driver
from test_batches import BEAMS, NAMES, Hand

from protocol.shared_memory.limits import obstacle
from sim_server.network import dispatch, link, worker_choice
from sim_server.network.batch_intake import BatchIntake
from tests.ports import free_endpoint

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(bool(obstacle()), reason=f"no shared memory here: {obstacle()}"),
]


@pytest.fixture(autouse=True)
def no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_choice, "QUEUE_SECONDS", 60.0)
    monkeypatch.setattr(link, "MESSAGE_THREADS", 0)  # each test has its own


@contextmanager
def staged(clock: Callable[[], float] | None = None) -> Iterator[Hand]:
    endpoint, options = free_endpoint(), {} if clock is None else {"clock": clock}
    with (
        link.ServerLink(listen=[endpoint], silence=600, **options) as server,
        HandWorker(endpoint, server.incarnation, shared_memory=True) as hand,
    ):
        played = Hand(Driver(server), hand)
        for beam in BEAMS.values():
            server.announce(beam)
        played.hello()
        played.driver.until(server.dispatch.ready, "the worker")
        played.first_factors()
        yield played


def gone(played: Hand) -> bool:
    return played.driver.link.dispatch.worker_info("hand") is None


def test_a_worker_that_leaves_has_answered_before_though_a_thread_has_its_answer_in_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread has received it, and waits for Python's lock, while it is seen that the worker is gone."""
    monkeypatch.setattr(dispatch, "PARTING", 600.0)
    go = Event()
    with staged() as played:
        batches = played.driver.link.dispatch._intake.batches

        def run() -> None:
            sample = batches._ring.recv()
            go.wait(60)
            batches._room.acquire()
            batches._take_in(sample)

        Thread(target=run, daemon=True).start()
        played.send(played.answer(played.batch()))
        played.hand.token.undeclare()
        played.driver.until(lambda: gone(played), "the end of the worker")
        assert not played.made() and not played.failed()
        go.set()
        played.driver.until(lambda: played.made() == set(NAMES), "its factors")
        assert not played.failed() and played.driver.link.slots_lent == 0


def test_jobs_of_a_worker_that_leaves_without_an_answer_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "PARTING", 0.01)
    with staged() as played:
        played.batch()
        played.hand.token.undeclare()
        played.driver.until(lambda: played.failed() == set(NAMES), "the end of its jobs")
        assert gone(played) and not played.made() and played.driver.link.slots_lent == 0
        assert played.driver.link.counters.jobs_lost == len(NAMES)


def test_an_error_that_no_check_foresees_keeps_no_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is gone, its jobs are over, and the run goes on."""
    monkeypatch.setattr(dispatch, "PARTING", 0.01)
    monkeypatch.setattr(BatchIntake, "_matched", lambda *_: {}["nose"])
    with staged() as played:
        message = played.answer(played.batch())
        message.jobs[1] = 10**9
        played.send(message)
        played.hand.token.undeclare()
        played.driver.until(lambda: played.failed() == set(NAMES), "the end of its jobs")
        assert played.driver.link.counters.refusals == {"unexpected": 1} and not played.driver.link.dispatch.decoding


def test_jobs_of_a_worker_that_comes_back_at_once_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that its new process gets are not."""
    monkeypatch.setattr(dispatch, "PARTING", 600.0)
    with staged() as played:
        played.batch()
        played.hand.token.undeclare()
        played.driver.until(lambda: gone(played), "the end of the worker")
        played.hello()
        played.driver.until(lambda: played.failed() == set(NAMES), "the end of its jobs")
        assert not played.driver.link.dispatch.leases.jobs


def test_a_lease_does_not_end_while_its_answer_waits_for_a_thread() -> None:
    now = [0.0]
    with staged(lambda: now[0]) as played:
        played.send(played.answer(played.batch()))
        played.hello()  # comes behind it
        sent = played.hand.sequence
        played.driver.until(
            lambda: played.driver.link.dispatch.worker_info("hand").header.sequence == sent, "what was sent behind it"
        )
        assert not played.made()
        now[0] += 1000.0
        played.driver.until(lambda: played.made() | played.failed() == set(NAMES), "the answers")
        assert played.made() == set(NAMES) and not played.driver.link.counters.leases_over
