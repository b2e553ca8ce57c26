# SPDX-License-Identifier: MIT
"""Who counts as a worker, without a network."""

import pytest

from protocol import PROTOCOL, Refused
from protocol.channels import key
from protocol.messages_pb2 import Header, WorkerInfo
from sim_server.network.roster import WORKERS, Roster


def hello(name: str = "w", sequence: int = 1, pid: int = 10) -> bytes:
    header = Header(protocol=PROTOCOL, incarnation=7, sequence=sequence)
    return WorkerInfo(header=header, worker=name, pid=pid, host="h").SerializeToString()


@pytest.fixture
def roster() -> Roster:
    return Roster(7, silence=2.0)


def test_token_and_hello_make_a_worker_in_either_order(roster: Roster) -> None:
    roster.token("w", True)
    assert roster.fit(0.0, {}) == []
    assert roster.hello(key("worker", worker="w"), hello(), 0.0) == ("w", True)
    roster.hello(key("worker", worker="x"), hello("x"), 0.0)
    assert roster.fit(0.0, {}) == ["w"]
    roster.token("x", True)
    assert roster.fit(0.0, {}) == ["w", "x"]


def test_silence_makes_unfit_unless_the_worker_is_busy(roster: Roster) -> None:
    roster.token("w", True)
    roster.hello(key("worker", worker="w"), hello(), 0.0)
    assert roster.fit(2.0, {}) == ["w"] and roster.fit(2.1, {}) == []
    assert roster.fit(2.1, {"w": 5.0}) == ["w"]
    assert roster.hello(key("worker", worker="w"), hello(sequence=2), 3.0) == ("w", False)
    assert roster.fit(3.5, {}) == ["w"]
    roster.heard("w", 9.0)
    assert roster.fit(10.0, {}) == ["w"]


def test_a_worker_leaves_by_its_token(roster: Roster) -> None:
    roster.token("w", True)
    roster.hello(key("worker", worker="w"), hello(), 0.0)
    assert roster.token("w", False)
    assert roster.fit(0.0, {}) == [] and roster.info("w") is None
    assert not roster.token("w", False)


def test_another_process_takes_the_name_over_only_from_a_silent_one(roster: Roster) -> None:
    where = key("worker", worker="w")
    roster.hello(where, hello(), 0.0)
    with pytest.raises(Refused, match="give each worker a name of its own"):
        roster.hello(where, hello(pid=11), 1.0)
    assert roster.hello(where, hello(pid=11), 2.5) == ("w", True)


def test_old_and_repeated_heartbeats_are_refused(roster: Roster) -> None:
    where = key("worker", worker="w")
    roster.hello(where, hello(sequence=5), 0.0)
    for sequence in (5, 4):
        with pytest.raises(Refused, match="allowed: more than 5"):
            roster.hello(where, hello(sequence=sequence), 1.0)


def test_their_number_is_bounded(roster: Roster) -> None:
    for k in range(WORKERS):
        roster.hello(key("worker", worker=f"w{k}"), hello(f"w{k}"), 0.0)
    with pytest.raises(Refused, match=f"{WORKERS} workers are known already"):
        roster.hello(key("worker", worker="one-more"), hello("one-more"), 0.0)
