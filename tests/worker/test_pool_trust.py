# SPDX-License-Identifier: MIT
"""What a worker of a pool believes, in simulated time: names without a server and forged needs cost it no work."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from precond_worker.network.pool import Pool
from precond_worker.network.trust import AVOIDED, CONFLICTS, LONGEST_AVOIDED, NO_JOB, Sent, Speakers, Trust
from protocol.channels import PROTOCOL, key
from protocol.counters import Counters
from protocol.messages_pb2 import Header, Need


class Network:
    """One pool worker, looking twice a second at servers that the test plays. Real ones send jobs when served."""

    def __init__(self) -> None:
        self.now = 0.0
        self.hear: dict[str, Callable[[Any], None]] = {}
        session: Any = SimpleNamespace(declare_subscriber=self._subscribe, liveliness=lambda: self)
        counters = Counters(SimpleNamespace(warning=lambda *_: None))  # type: ignore[arg-type]
        self.pool = Pool(session, "w", counters, threading.Event(), lambda: self.now)
        self.real: dict[str, float] = {}  # need of each
        self.fakes: list[str] = []
        self.forged: dict[str, float] = {}  # needs in the names of real ones
        self.numbers: dict[str, int] = {}
        self.sent: dict[str, Sent] = {}
        self.shares: dict[str, float] = {}
        self.time_at: dict[str, float] = {}

    def _subscribe(self, where: str, heard: Callable[[Any], None], **_: Any) -> object:
        self.hear["need" if where.endswith("/need") else "token"] = heard
        return object()

    declare_subscriber = _subscribe

    def token(self, server: str, incarnation: int = 7, there: bool = True) -> None:
        kind = zenoh.SampleKind.PUT if there else zenoh.SampleKind.DELETE
        where = key("alive_server", server, incarnation=f"{incarnation:016x}")
        self.hear["token"](SimpleNamespace(key_expr=where, kind=kind))

    def tell(self, server: str, lost: float, workers: float, incarnation: int = 7, number: int | None = None) -> None:
        if number is None:
            number = self.numbers[server] = self.numbers.get(server, 0) + 1
        header = Header(protocol=PROTOCOL, incarnation=incarnation, sequence=number)
        data = Need(header=header, lost=lost, workers=workers).SerializeToString()
        payload = SimpleNamespace(to_bytes=lambda: data)
        self.hear["need"](SimpleNamespace(key_expr=key("need", server), payload=payload))

    def add(self, server: str, lost: float) -> None:
        self.real[server] = lost
        self.token(server)

    def run(self, seconds: float, check: Callable[[dict[str, float]], None] = lambda wanted: None) -> None:
        for _ in range(round(2 * seconds)):
            self.now += 0.5
            for name, lost in self.real.items():
                share = self.shares.get(name, 0.0)
                self.tell(name, lost / (1 + share), share)
            for name in self.fakes if self.now % 3 == 0 else ():
                self.tell(name, 64.0, 0.0)
            for name, lost in self.forged.items():
                self.tell(name, lost, 0.0, number=self.numbers[name] + 1)
            wanted = self.shares = self.pool.wanted(self.sent)
            for name in wanted:
                self.time_at[name] = self.time_at.get(name, 0.0) + 0.5
            made = {name: self.sent[name].factors if name in self.sent else 0 for name in wanted}
            self.sent = {name: Sent(made[name] + (self.real.get(name, 0.0) > 0), False) for name in wanted}
            check(wanted)

    def attack(self, count: int) -> None:
        """So many names without a server say that they need workers more than anybody."""
        self.fakes = [f"fake{k}" for k in range(count)]
        for name in self.fakes:
            self.token(name)
            self.tell(name, 64.0, 0.0)


def holds(*names: str) -> Callable[[dict[str, float]], None]:
    def check(wanted: dict[str, float]) -> None:
        assert set(names) <= set(wanted), wanted

    return check


def test_names_without_a_server_take_no_worker_away_and_are_tried_ever_more_rarely() -> None:
    network = Network()
    network.add("sim", 0.05)
    network.run(5)
    network.attack(20)
    network.run(600, holds("sim"))
    tried = sum(network.time_at.get(name, 0.0) for name in network.fakes)
    network.run(600, holds("sim"))
    later = sum(network.time_at.get(name, 0.0) for name in network.fakes) - tried
    assert 2 * NO_JOB <= tried < 0.2 * 600 and later < 0.05 * 600
    assert network.pool.wanted(network.sent)["sim"] == 1.0, "it counts as a whole worker there"


def test_a_worker_that_starts_among_them_finds_the_server() -> None:
    network = Network()
    network.attack(30)
    network.add("sim", 0.05)
    network.run(NO_JOB * (2 + 30 / 4))
    assert "sim" in network.sent
    network.run(300, holds("sim"))


def test_it_still_goes_where_it_is_needed_most() -> None:
    network = Network()
    network.add("a", 1.0)
    network.add("b", 1e-4)
    network.run(30)
    network.real["b"] = 1e-2
    network.run(30)
    network.real["b"] = 1e-4
    network.run(30, holds("a"))
    network.attack(20)
    network.run(100, holds("a"))
    network.real |= {"a": 0.01, "b": 5.0}
    network.run(100)
    network.run(100, holds("b"))


def test_a_server_that_told_no_need_stays_served_when_somebody_tells_one_in_its_name() -> None:
    """It had no seat until then, so that none is kept while others are tried."""
    network = Network()
    network.token("sim")
    for _ in range(20):
        network.now += 0.5
        shares = network.pool.wanted(network.sent)
        network.sent = {name: Sent(network.sent.get(name, Sent(0, False)).factors + 1, False) for name in shares}
    assert shares == {"sim": 1.0}
    network.attack(6)
    network.tell("sim", 0.0, 0.0)
    network.real["sim"] = 0.0
    network.run(100, holds("sim"))


@pytest.mark.parametrize("lost", [0.0, 64.0])
def test_needs_in_the_name_of_another_neither_starve_nor_feed_it(lost: float) -> None:
    """Who speaks in the name of a server that speaks itself is found out: it is served in turn with the others."""
    network = Network()
    network.add("a", 0.2)
    network.add("b", 0.2)
    network.run(60)
    network.forged = {"a": lost}
    network.run(10)
    network.run(200, holds("a", "b"))
    assert network.pool.wanted(network.sent) == {"a": 0.5, "b": 0.5}
    network.forged = {}
    network.real["a"] = 1e-4
    network.run(100)
    assert network.sent.keys() == {"b"}, "what it tells is believed again"


def test_a_server_that_starts_again_is_believed() -> None:
    network = Network()
    network.add("a", 0.2)
    network.add("b", 1e-4)
    network.run(20)
    for life in range(8, 14):  # each is known before the last one is gone
        network.numbers["a"] = 0
        network.token("a", life)
        network.tell("a", 0.2, 0.0, life)
        network.token("a", life - 1, there=False)
        for number in range(2, 12):
            network.now += 0.5
            network.tell("a", 0.2, 1.0, life, number)
            network.tell("b", 1e-4, 0.0)
            network.sent = {name: Sent(20 + number, True) for name in network.pool.wanted(network.sent)}
        assert network.sent.keys() == {"a"}, "its need counts: it alone is served"


def test_who_speaks_in_the_name_of_another_is_found_out() -> None:
    for numbers, odd in (([1, 2, 3, 4, 5, 6], False), ([1, 2, 2, 3, 3, 4, 4], True), ([1, 9, 2, 9, 3, 9, 4], True)):
        speakers = Speakers()
        for number in numbers:
            speakers.hear("sim", 7, number, 0.5 * number)
        assert speakers.contested("sim", 5.0) == odd, numbers
        assert not speakers.contested("sim", 100.0) and not speakers.contested("other", 5.0)
    for lives, odd in (
        ([1, 1, 2, 2, 2], False),
        ([1, 2, 1, 2, 1, 2, 1], True),
        (list(range(30)), True),
        (list(range(12)), False),
    ):
        speakers = Speakers()
        for number, life in enumerate(lives):
            speakers.hear("sim", life, number, 0.5 * number)
        assert speakers.contested("sim", 5.0) == odd, lives
    assert CONFLICTS > 1, "one message out of order is no forgery"


def test_who_asks_and_sends_nothing_is_avoided_for_longer_each_time() -> None:
    trust, now, avoided = Trust(), 0.0, []
    for _ in range(9):
        began = now
        while not trust.update({"fake": Sent(0, False)}, {"fake"}, now):
            now += 0.5
        assert NO_JOB < now - began <= NO_JOB + 1.0 and not trust.is_proven("fake")
        began = now
        while trust.is_avoided("fake", now):
            now += 0.5
            trust.update({}, {"fake"}, now)
        avoided.append(now - began)
    assert avoided == [min(AVOIDED * 2.0**k, LONGEST_AVOIDED) for k in range(9)]
    trust.update({"fake": Sent(1, False)}, {"fake"}, now)
    assert trust.is_proven("fake")
    trust.keep(["other"])
    assert not trust.is_proven("fake")


def test_who_does_not_ask_or_whose_job_waits_is_not_avoided() -> None:
    trust = Trust()
    for now in range(100):
        assert trust.update({"idle": Sent(0, False), "busy": Sent(1, True)}, {"busy"}, float(now)) == set()
    trust.reject("busy", 100.0)
    assert trust.is_avoided("busy", 101.0) and not trust.is_proven("busy")
