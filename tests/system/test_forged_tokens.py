# SPDX-License-Identifier: MIT
"""Tokens and hellos that anybody may send take no worker away; played against real processes."""

import logging
import time
from collections.abc import Iterator

import pytest
import zenoh
from hand_worker import HandWorker
from link_helpers import Driver, chain, free_endpoint, light_worker

from protocol.channels import key
from protocol.messages_pb2 import Header, WorkerInfo
from protocol.session import open_session
from sim_server.network.link import ServerLink
from sim_server.network.roster import TOKENS, WORKERS

pytestmark = pytest.mark.system

BEAM = chain()


class Forger:
    """A session of its own that declares what it likes."""

    def __init__(self, endpoint: str):
        self.session = open_session("client", connect=[endpoint], shared_memory=False)
        self.zenoh = self.session.zenoh

    def tokens(self, channel: str, names: list[str]) -> list[zenoh.LivelinessToken]:
        field = {"alive_worker": "worker", "alive_server": "incarnation"}[channel]
        return [self.zenoh.liveliness().declare_token(key(channel, **{field: name})) for name in names]

    def hello(self, incarnation: int, name: str, sequence: int = 1, pid: int = 1, host: str = "here") -> None:
        header = Header(protocol=1, incarnation=incarnation, sequence=sequence)
        info = WorkerInfo(header=header, worker=name, pid=pid, host=host)
        self.zenoh.put(
            key("worker", worker=name), info.SerializeToString(), congestion_control=zenoh.CongestionControl.BLOCK
        )


@pytest.fixture
def stage() -> Iterator[tuple[str, Driver, Forger]]:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint], shared_memory=False) as link:
        driver, forger = Driver(link), Forger(endpoint)
        link.announce(BEAM)
        with forger.session:
            yield endpoint, driver, forger


def known_tokens(driver: Driver) -> int:
    return len(driver.link._dispatch._roster._tokens)


def test_a_worker_joins_behind_more_idle_tokens_than_are_kept(
    stage: tuple[str, Driver, Forger], caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, driver, forger = stage
    with caplog.at_level(logging.WARNING):
        tokens = forger.tokens("alive_worker", [f"fake{k}" for k in range(TOKENS + 50)])
        driver.until(lambda: driver.link.counters.refusals["limit"] >= 50, "the limit")
        with light_worker(endpoint, "real"):
            driver.factor(BEAM, 1)
            assert [worker.worker for worker in driver.link.workers()] == ["real"]
            for token in tokens:
                token.undeclare()
            driver.until(lambda: known_tokens(driver) == 0, "the fakes to leave")
            driver.factor(BEAM, 2)
    told = [record.message for record in caplog.records if "others have said nothing yet" in record.message]
    assert len(told) == 1, "told once, counted from then on"


def test_a_worker_joins_behind_hellos_without_a_token(stage: tuple[str, Driver, Forger]) -> None:
    endpoint, driver, forger = stage
    for k in range(WORKERS + 10):
        forger.hello(driver.link.incarnation, f"ghost{k}")
    with light_worker(endpoint, "real"):
        driver.factor(BEAM, 1)


def test_a_token_that_was_forgotten_is_asked_for_when_its_worker_speaks(stage: tuple[str, Driver, Forger]) -> None:
    endpoint, driver, forger = stage
    with HandWorker(endpoint, driver.link.incarnation) as hand:
        driver.until(lambda: known_tokens(driver) == 1, "the token of one that says nothing yet")
        forger.tokens("alive_worker", [f"fake{k}" for k in range(TOKENS)])
        driver.until(lambda: driver.link.counters.refusals["limit"] >= 1, "it to be forgotten")

        def ready() -> int:
            hand.hello()
            time.sleep(0.05)
            return driver.link.ready()

        driver.until(ready, "the worker")
        assert [worker.worker for worker in driver.link.workers()] == ["hand"]


def test_forged_heartbeats_do_not_shut_a_worker_out(stage: tuple[str, Driver, Forger]) -> None:
    endpoint, driver, forger = stage
    with light_worker(endpoint, "real") as child:
        driver.factor(BEAM, 1)
        host = driver.link.workers()[0].host
        forger.hello(driver.link.incarnation, "real", 2**63, child.pid, host)
        driver.factor(BEAM, 2)
        driver.until(lambda: driver.link.workers()[0].jobs == 2, "heartbeats of the real one")
        assert driver.link.counters.refusals["sequence"] == 0
