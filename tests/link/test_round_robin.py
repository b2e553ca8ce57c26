# SPDX-License-Identifier: MIT
"""Which servers a worker serves, and in which order, without a network."""

import threading

import pytest

from precond_worker.network.server_addresses import ServerAddress, server_addresses
from precond_worker.round_robin import RoundRobin
from protocol.channels import DEFAULT_ENDPOINT, ROOT, key, server_in
from protocol.refused import Refused

HERE, THERE = "tcp/127.0.0.1:7447", "tcp/10.0.0.5:7447"


@pytest.mark.parametrize(
    ("servers", "connect", "expected"),
    [
        (["sim"], [], [ServerAddress((DEFAULT_ENDPOINT,), ("sim",))]),
        (["a", "b"], [HERE, THERE], [ServerAddress((HERE, THERE), ("a", "b"))]),
        (
            [f"a@{HERE}", f"b@{THERE}", f"c@{HERE}"],
            [],
            [ServerAddress((HERE,), ("a", "c")), ServerAddress((THERE,), ("b",))],
        ),
        (["a", "*"], [HERE], [ServerAddress((HERE,), ("*",))]),
        ([f"*@{HERE}", "b"], [THERE], [ServerAddress((HERE,), ("*",)), ServerAddress((THERE,), ("b",))]),
    ],
)
def test_servers_are_grouped_by_where_they_are(
    servers: list[str], connect: list[str], expected: list[ServerAddress]
) -> None:
    assert server_addresses(servers, connect) == expected


@pytest.mark.parametrize("servers", [["a", "a"], ["a/b"], ["a@"], ["a@nonsense"], [f"@{HERE}"], ["a*"]])
def test_what_cannot_be_a_server_is_refused(servers: list[str]) -> None:
    with pytest.raises(ValueError):
        server_addresses(servers, [])


def test_a_key_names_its_server() -> None:
    assert server_in(key("alive_server", "sim-3", incarnation="0f")) == "sim-3"
    assert key("alive_server", "*") == f"{ROOT}/*/alive/server/*"
    for wrong in ("elsewhere/sim/status", f"{ROOT}", f"{ROOT}//status", f"{ROOT}/a b/status"):
        with pytest.raises(Refused):
            server_in(wrong)


class Desk:
    """A server's jobs as the rota sees them: so many waiting, and who was served."""

    def __init__(self, name: str, waiting: int, served: list[str]):
        self.name, self.waiting, self.served = name, waiting, served
        self.finished: list[str] = []  # who had been served until then, each time
        self.pause = float("inf")

    def take_in(self, timeout: float) -> None:
        assert timeout == 0.0, "one server must not hold up the others"

    def work(self) -> bool:
        if not self.waiting:
            return False
        self.waiting -= 1
        self.served.append(self.name)
        return True

    def finish(self) -> None:
        self.finished.append("".join(self.served))


def test_servers_with_jobs_are_served_in_turn() -> None:
    served: list[str] = []
    round_robin = RoundRobin(threading.Event())
    desks = {name: Desk(name, count, served) for name, count in (("a", 4), ("b", 0), ("c", 2), ("d", 1))}
    for desk in desks.values():
        round_robin.add(desk)  # type: ignore[arg-type]
    for _ in range(3):
        round_robin.step(0.0)
    assert sorted(served) == ["a", "c", "d"], "each has had one before any has two"
    desks["b"].waiting = 1
    for _ in range(6):
        round_robin.step(0.0)
    assert sorted(served) == ["a"] * 4 + ["b", "c", "c", "d"]
    assert "b" in served[3:6], "a server that had none waits for no more than one job of each other"


def test_it_waits_no_longer_than_until_there_is_something_to_prepare() -> None:
    wake = threading.Event()
    waits: list[float] = []
    wake.wait = lambda timeout=None: bool(waits.append(timeout))  # type: ignore[method-assign, assignment]
    round_robin, desks = RoundRobin(wake), [Desk(name, 0, []) for name in "ab"]
    for desk in desks:
        round_robin.add(desk)  # type: ignore[arg-type]
    round_robin.step(9.0)
    desks[1].pause = 0.25
    round_robin.step(9.0)
    assert waits == [9.0, 0.25]


def test_the_bell_ends_the_wait() -> None:
    round_robin = RoundRobin(threading.Event())
    round_robin.add(Desk("a", 0, []))  # type: ignore[arg-type]
    round_robin.step(0.0)
    assert not round_robin.wake.is_set()
    threading.Timer(0.05, round_robin.wake.set).start()
    round_robin.step(60.0)  # the test's own limit ends it otherwise
    assert not round_robin.wake.is_set()


def test_what_is_under_way_is_finished_before_the_job_of_another_server() -> None:
    served: list[str] = []
    round_robin = RoundRobin(threading.Event())
    a, b = Desk("a", 3, served), Desk("b", 0, served)
    for desk in (a, b):
        round_robin.add(desk)  # type: ignore[arg-type]
    round_robin.step(0.0)
    round_robin.step(0.0)
    assert a.finished == [], "nobody else waits: the next jobs are made ready meanwhile"
    b.waiting = 1
    round_robin.step(0.0)
    round_robin.step(0.0)
    assert "".join(served) in ("aaba", "aaab") and a.finished == ["".join(served).split("b")[0]]
