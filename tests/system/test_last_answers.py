# SPDX-License-Identifier: MIT
"""Answers to several jobs that have come count, though no thread has taken them in yet when their jobs would end."""

import threading
from types import SimpleNamespace

import pytest
from test_batches import NAMES, Hand, staged

from protocol.shared_memory.limits import obstacle
from sim_server.network import batch_intake, dispatch, link, worker_choice
from sim_server.network.leases import Leases

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(bool(obstacle()), reason=f"no shared memory here: {obstacle()}"),
]


@pytest.fixture(autouse=True)
def no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_choice, "QUEUE_SECONDS", 60.0)
    monkeypatch.setattr(link, "MESSAGE_THREADS", 0)


def gone(played: Hand) -> bool:
    return played.driver.link.dispatch.worker_info("hand") is None


def test_a_worker_that_leaves_has_answered_before_though_a_thread_has_its_answer_in_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread has received it, and waits for Python's lock, while it is seen that the worker is gone."""
    monkeypatch.setattr(dispatch, "PARTING", 600.0)
    monkeypatch.setattr(link, "MESSAGE_THREADS", 1)
    go = threading.Event()

    class Held:
        """A lock that a thread of messages, which has received one, does not get before `go`."""

        def __enter__(self) -> None:
            assert threading.current_thread() is threading.main_thread() or go.wait(60)

        def __exit__(self, *_: object) -> None:
            pass

    changed = {"Lock": Held, "Semaphore": threading.Semaphore, "get_ident": threading.get_ident}
    monkeypatch.setattr(batch_intake, "threading", SimpleNamespace(**changed))
    with staged() as played:
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
    with staged() as played:
        monkeypatch.setattr(Leases, "match_answer", lambda *_: {}["nose"])
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
