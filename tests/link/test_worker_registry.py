# SPDX-License-Identifier: MIT
"""Which workers are registered and available, without a network."""

import pytest

from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Header, WorkerInfo
from protocol.refused import Refused
from sim_server.network.worker_registry import TOKENS, WORKERS, WorkerRegistry


def hello(name: str = "w", sequence: int = 1, pid: int = 10, idle: bool = False) -> bytes:
    header = Header(protocol=PROTOCOL, incarnation=7, sequence=sequence)
    return WorkerInfo(header=header, worker=name, pid=pid, host="h", idle=idle).SerializeToString()


@pytest.fixture
def registry() -> WorkerRegistry:
    return WorkerRegistry(7, silence=2.0)


def test_token_and_hello_make_a_worker_in_either_order(registry: WorkerRegistry) -> None:
    registry.set_token("w", True)
    assert registry.available(0.0, {}) == []
    assert registry.heartbeat(key("worker", worker="w"), hello(), 0.0) == ("w", True, "")
    registry.heartbeat(key("worker", worker="x"), hello("x"), 0.0)
    assert registry.available(0.0, {}) == ["w"]
    registry.set_token("x", True)
    assert registry.available(0.0, {}) == ["w", "x"]


def test_silence_makes_unavailable_unless_the_worker_is_busy(registry: WorkerRegistry) -> None:
    registry.set_token("w", True)
    registry.heartbeat(key("worker", worker="w"), hello(), 0.0)
    assert registry.available(2.0, {}) == ["w"] and registry.available(2.1, {}) == []
    assert registry.available(2.1, {"w": 5.0}) == ["w"]
    assert registry.heartbeat(key("worker", worker="w"), hello(sequence=2), 3.0) == ("w", False, "")
    assert registry.available(3.5, {}) == ["w"]
    registry.mark_seen("w", 9.0)
    assert registry.available(10.0, {}) == ["w"]
    registry.mark_seen("w", 7.0)  # told of late
    assert registry.available(10.0, {}) == ["w"]


def test_a_worker_leaves_by_its_token(registry: WorkerRegistry) -> None:
    registry.set_token("w", True)
    registry.heartbeat(key("worker", worker="w"), hello(), 0.0)
    assert registry.set_token("w", False)
    assert registry.available(0.0, {}) == [] and registry.info("w") is None
    assert not registry.set_token("w", False)


def test_another_process_takes_the_name_over_only_from_a_silent_one(registry: WorkerRegistry) -> None:
    where = key("worker", worker="w")
    registry.heartbeat(where, hello(), 0.0)
    with pytest.raises(Refused, match="give each worker a name of its own"):
        registry.heartbeat(where, hello(pid=11), 1.0)
    assert registry.heartbeat(where, hello(pid=11), 2.5) == ("w", True, "")


def test_old_and_repeated_heartbeats_are_refused(registry: WorkerRegistry) -> None:
    where = key("worker", worker="w")
    registry.heartbeat(where, hello(sequence=5), 0.0)
    for sequence in (5, 4):
        with pytest.raises(Refused, match="allowed: more than 5"):
            registry.heartbeat(where, hello(sequence=sequence), 1.0)


def test_a_forged_heartbeat_with_a_huge_number_does_not_shut_the_worker_out(registry: WorkerRegistry) -> None:
    where = key("worker", worker="w")
    registry.heartbeat(where, hello(sequence=5), 0.0)
    registry.heartbeat(where, hello(sequence=2**63), 0.1)
    registry.set_token("w", True)
    for sequence in (6, 7, 8):
        assert registry.heartbeat(where, hello(sequence=sequence), 0.2 * sequence) == ("w", False, "")
    assert registry.available(3.5, {}) == ["w"]


def join(registry: WorkerRegistry, name: str, now: float = 0.0) -> tuple[str, bool, str]:
    registry.set_token(name, True)
    return registry.heartbeat(key("worker", worker=name), hello(name), now)


def test_their_number_is_bounded(registry: WorkerRegistry) -> None:
    for k in range(WORKERS):
        join(registry, f"w{k}")
    with pytest.raises(Refused, match=f"{WORKERS} workers are known already") as refused:
        join(registry, "one-more")
    assert refused.value.kind == "limit"
    assert registry.set_token("w7", False)
    assert join(registry, "one-more") == ("one-more", True, "")


def test_who_has_no_token_or_is_silent_holds_no_place_against_a_worker_that_speaks(registry: WorkerRegistry) -> None:
    for k in range(WORKERS - 1):
        join(registry, f"w{k}", 10.0 if k != 3 else 8.5)
    registry.heartbeat(key("worker", worker="ghost"), hello("ghost"), 10.0)
    assert join(registry, "one", 10.0) == ("one", True, "ghost")
    with pytest.raises(Refused):
        join(registry, "two", 10.0)
    assert join(registry, "two", 11.0) == ("two", True, "w3"), "silent for longest"
    assert "w3" not in registry.available(11.0, {}) and registry.info("w3") is None
    registry.set_token("w5", False)
    registry.heartbeat(key("worker", worker="w3"), hello("w3", sequence=2), 11.0)
    assert "w3" in registry.available(11.0, {}), "its token was not forgotten"


def test_a_busy_worker_may_be_silent_and_keeps_its_place(registry: WorkerRegistry) -> None:
    for k in range(WORKERS):
        join(registry, f"w{k}", 10.0 if k else 0.0)
    registry.set_token("new", True)
    with pytest.raises(Refused):
        registry.heartbeat(key("worker", worker="new"), hello("new"), 10.0, {"w0": 60.0})


def test_of_tokens_that_say_nothing_the_oldest_is_forgotten(registry: WorkerRegistry) -> None:
    join(registry, "real")
    for k in range(TOKENS):
        registry.set_token(f"fake{k}", True)
    with pytest.raises(Refused, match="the oldest, 'fake0', is forgotten") as refused:
        registry.set_token("late", True)
    assert refused.value.kind == "limit"
    assert registry.heartbeat(key("worker", worker="late"), hello("late"), 0.0) == ("late", True, "")
    assert registry.available(0.0, {}) == ["real", "late"]


def test_a_worker_that_speaks_without_a_token_is_looked_for(registry: WorkerRegistry) -> None:
    join(registry, "w")
    registry.heartbeat(key("worker", worker="x"), hello("x"), 0.0)
    assert registry.without_token(1.0) == {"x"}
    assert registry.without_token(2.5) == set(), "and is forgotten when it is silent"
    registry.set_token("x", True)
    assert registry.without_token(1.0) == set() and registry.available(1.0, {}) == ["w", "x"]


def test_idle_is_who_says_so_in_every_heartbeat(registry: WorkerRegistry) -> None:
    where = key("worker", worker="w")

    def said(sequence: int, now: float, idle: bool = True, pid: int = 10) -> tuple[float, float] | None:
        registry.heartbeat(where, hello(sequence=sequence, idle=idle, pid=pid), now)
        return registry.idle_period("w")

    assert registry.idle_period("w") is None
    assert (said(1, 1.0), said(2, 1.2), said(3, 1.4)) == ((1.0, 1.0), (1.0, 1.2), (1.0, 1.4))
    registry.mark_seen("w", 2.0)
    assert registry.idle_period("w") == (1.0, 1.4), "an answer says nothing of what is in hand"
    assert (said(4, 1.6, idle=False), said(5, 1.8), said(6, 2.0)) == (None, (1.8, 1.8), (1.8, 2.0))
    assert said(7, 3.5) == (3.5, 3.5), "nobody knows what it did meanwhile"
    assert said(1, 9.0, pid=11) == (9.0, 9.0), "another life"
