# SPDX-License-Identifier: MIT
"""Tokens and hellos that anybody may send take no worker away; played against real processes."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from hand_worker import HandWorker
from link_helpers import Driver, chain, light_worker, process

from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Header, WorkerInfo
from protocol.network.session import open_session
from sim_server.network.link import ServerLink
from sim_server.network.worker_registry import TOKENS, WORKERS
from tests.ports import free_endpoint

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
        header = Header(protocol=PROTOCOL, incarnation=incarnation, sequence=sequence)
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
    return driver.link.dispatch.unclaimed_tokens()


def test_a_worker_joins_behind_more_idle_tokens_than_are_kept(
    stage: tuple[str, Driver, Forger], caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, driver, forger = stage
    with caplog.at_level(logging.WARNING):
        tokens = forger.tokens("alive_worker", [f"fake{k}" for k in range(TOKENS + 50)])
        driver.until(lambda: driver.link.counters.refusals["limit"] >= 50, "the limit")
        with light_worker(endpoint, "real"):
            driver.factor(BEAM, 1)
            assert [worker.worker for worker in driver.link.dispatch.workers()] == ["real"]
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
            return driver.link.dispatch.ready()

        driver.until(ready, "the worker")
        assert [worker.worker for worker in driver.link.dispatch.workers()] == ["hand"]


def test_forged_heartbeats_do_not_shut_a_worker_out(stage: tuple[str, Driver, Forger]) -> None:
    endpoint, driver, forger = stage
    with light_worker(endpoint, "real") as child:
        driver.factor(BEAM, 1)
        host = driver.link.dispatch.workers()[0].host
        forger.hello(driver.link.incarnation, "real", 2**63, child.pid, host)
        driver.factor(BEAM, 2)
        driver.until(lambda: driver.link.dispatch.workers()[0].jobs == 2, "heartbeats of the real one")
        assert driver.link.counters.refusals["sequence"] == 0


FORGED = "00000000deadbeef"


def test_a_forged_token_of_a_server_takes_no_worker_away(stage: tuple[str, Driver, Forger]) -> None:
    endpoint, driver, forger = stage
    with light_worker(endpoint, "real") as child:
        driver.factor(BEAM, 1)
        (token,) = forger.tokens("alive_server", [FORGED])
        forger.tokens("alive_server", [f"{k:016x}" for k in range(1, 300)])
        time.sleep(1.0)  # in which it would have followed the newest
        driver.factor(BEAM, 2)
        token.undeclare()
        driver.factor(BEAM, 3)
        assert child.poll() is None and driver.link.counters.jobs_lost == 0


def test_a_worker_finds_the_server_among_forged_tokens_and_a_new_life_of_it_too() -> None:
    """Everybody meets at a router, so that the forged tokens outlive the server."""
    meeting, incarnations = free_endpoint(), set()
    with open_session("server", listen=[meeting], shared_memory=False):
        forger = Forger(meeting)
        with forger.session, light_worker(meeting, "real") as child:
            forger.tokens("alive_server", [f"{k:016x}" for k in range(1, 50)])
            for life in range(2):
                with ServerLink(listen=[free_endpoint()], connect=[meeting], shared_memory=False) as link:
                    driver = Driver(link)
                    link.announce(BEAM)
                    driver.factor(BEAM, life + 1)
                    forger.tokens("alive_server", [f"{100 + life:016x}"])
                    driver.factor(BEAM, life + 2)
                    incarnations.add(link.incarnation)
            assert child.stdout is not None
            assert [child.stdout.readline().strip() for _ in range(4)] == ["ready", "gone", "ready", "gone"]
    assert len(incarnations) == 2


def test_a_worker_of_another_version_is_told_and_the_server_says_so_once(
    stage: tuple[str, Driver, Forger], caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, driver, _ = stage
    command = (str(Path(__file__).parent / "other_version.py"), "--connect", endpoint, "--name", "newer")
    with caplog.at_level(logging.WARNING), process(*command) as child:
        assert child.stderr is not None
        line = child.stderr.readline()
        assert (
            f"server sim speaks protocol version {PROTOCOL}, this worker version {PROTOCOL + 1}: it is not served"
            in line
        )
        driver.until(lambda: driver.link.counters.refusals["version"] >= 3, "it to ask again")
        assert driver.link.dispatch.workers() == []
        child.terminate()
        out, err = child.communicate(timeout=30)
        assert (out, err, child.returncode) == ("", "", 0)
    sentence = f"worker newer speaks protocol version {PROTOCOL + 1}"
    told = [record.message for record in caplog.records if sentence in record.message]
    assert len(told) == 1 and f"this server version {PROTOCOL}" in told[0]
