# SPDX-License-Identifier: MIT
"""An error that no check of messages foresees refuses the message: the server goes on, and so does its worker."""

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hand_worker import HandWorker
from link_helpers import Driver, chain, dense, matrix, product

from protocol.factor import FactorPattern
from sim_server.network import factor_decoder, factor_intake
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

BEAM = chain()
STEPS = iter(range(1, 1000))


@pytest.fixture
def stage() -> Iterator[tuple[Driver, HandWorker]]:
    """Each test has a server of its own, since a kind of refusals is logged once."""
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=False, silence=60) as link,
        HandWorker(endpoint, link.incarnation) as hand,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello()
        driver.until(link.dispatch.ready, "the worker")
        yield driver, hand


def round_of(driver: Driver, hand: HandWorker) -> int:
    """A matrix and its right answer; returns its step."""
    step = next(STEPS)
    driver.submit(BEAM, step, shift=0.5)
    hand.answer(*hand.right_answer(hand.receive(), BEAM, 0.5))
    return step


def taken(driver: Driver, hand: HandWorker) -> None:
    step = round_of(driver, hand)
    factor = driver.until(lambda: next((f for f in driver.factors if f.step == step), None), "a good factor")
    assert np.allclose(product(factor), dense(BEAM, matrix(BEAM, 0.5)), atol=1e-5)


def unexpected(driver: Driver, count: int) -> None:
    driver.until(lambda: driver.link.counters.refusals["unexpected"] >= count, f"{count} refusals")


def broken(*arguments: Any, **more: Any) -> Any:
    raise IndexError("index 7 is out of bounds")


@pytest.mark.parametrize("beside", [False, True], ids=["at once", "in a thread"])
def test_the_factor_is_refused_and_the_next_is_taken(
    stage: tuple[Driver, HandWorker], beside: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    driver, hand = stage
    caplog.set_level(logging.DEBUG)
    if beside:
        monkeypatch.setattr(factor_intake, "LARGE", 0)
    taken(driver, hand)
    monkeypatch.setattr(factor_decoder, "check_values", broken)
    for count in (1, 2):
        round_of(driver, hand)
        unexpected(driver, count)
    monkeypatch.undo()
    assert [name for name, _ in driver.failures] == ["beam", "beam"]
    assert driver.link.dispatch.consecutive_failures() == {}, "the worker may have done nothing wrong"
    assert "was refused: factor of beam by worker hand: IndexError: index 7 is out of bounds" in driver.failures[0][1]
    warned = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING and "IndexError" in r.getMessage()]
    assert len(warned) == 1 and "factor of beam by worker hand" in warned[0]
    traced = [r for r in caplog.records if r.exc_info]
    assert len(traced) == 2 and {r.levelno for r in traced} == {logging.DEBUG}
    taken(driver, hand)


def test_a_thread_that_cannot_start_costs_one_factor(
    stage: tuple[Driver, HandWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, hand = stage

    def full(*arguments: Any) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(factor_intake, "LARGE", 0)
        patch.setattr(ThreadPoolExecutor, "submit", full)
        round_of(driver, hand)
        unexpected(driver, 1)
    assert "can't start new thread" in driver.failures[0][1] and driver.link.dispatch.consecutive_failures() == {}
    taken(driver, hand)


def test_an_error_at_the_end_of_a_decoding_costs_its_factor_alone(
    stage: tuple[Driver, HandWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, hand = stage
    monkeypatch.setattr(factor_intake, "LARGE", 0)
    leases = driver.link.dispatch.leases
    match = leases.match_answer
    calls = [match, broken]
    with monkeypatch.context() as patch:
        patch.setattr(leases, "match_answer", lambda *each: (calls.pop(0) if calls else match)(*each))
        round_of(driver, hand)
        unexpected(driver, 1)
    assert [name for name, _ in driver.failures] == ["beam"]
    taken(driver, hand)


def test_a_pattern_or_a_heartbeat_is_dropped_and_the_next_is_read(
    stage: tuple[Driver, HandWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, hand = stage
    with monkeypatch.context() as patch:
        patch.setattr(FactorPattern, "from_message", broken)
        driver.submit(BEAM, next(STEPS))
        hand.right_answer(hand.receive(), BEAM)  # sends the pattern
        unexpected(driver, 1)
    with monkeypatch.context() as patch:
        patch.setattr("sim_server.network.worker_registry.check_strings", broken)
        hand.hello()
        unexpected(driver, 2)
    hand.put("factor", b"", hand.header().SerializeToString(), worker="hand", object="beam")
    driver.until(lambda: driver.link.counters.refused > 2, "a message that is none")
    assert driver.link.dispatch.worker_count() == 1
