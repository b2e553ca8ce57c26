# SPDX-License-Identifier: MIT
"""How often a server makes a status because clients ask for one."""

from types import SimpleNamespace

import pytest

from protocol import messages_pb2 as pb
from sim_server.service import service as module
from sim_server.service.service import STATUS_INTERVAL, STATUS_REST, Service


class Asked:
    """A service of which nothing but the answers to `status` runs, with a clock of its own.

    seconds: that a status takes. made: when statuses were made [s]
    """

    def __init__(self, seconds: float, monkeypatch: pytest.MonkeyPatch):
        self.now, self.seconds, self.answers = 0.0, seconds, 0
        self.made: list[float] = []
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now))
        self.service = Service.__new__(Service)
        self.service._status_due, self.service._status_replies = 0.0, []
        self.service.telemetry = SimpleNamespace(publish_status=self._publish)  # type: ignore[assignment]
        self.service._state = lambda: "running"  # type: ignore[method-assign]

    def _publish(self, state: str, where: bool) -> None:
        self.made.append(self.now)
        self.now += self.seconds

    def _answer(self, reply: pb.Reply) -> None:
        assert not reply.error
        self.answers += 1

    def round(self, requests: int, rest: float = 1e-3) -> None:
        """One round of the service thread, after which it sleeps."""
        self.service._status_replies += [self._answer] * requests
        self.service._publish_status()
        self.now += rest


def test_a_cheap_status_is_made_in_the_round_of_its_request(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(2e-4, monkeypatch)
    for _ in range(50):
        asked.round(requests=3)
    assert asked.answers == 150 and len(asked.made) == 50


@pytest.mark.parametrize("seconds", [1e-3, 4e-3])
def test_statuses_take_a_quarter_of_the_time_however_many_ask(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(seconds, monkeypatch)
    for _ in range(2000):
        asked.round(requests=10)
    share = len(asked.made) * seconds / asked.now
    assert 0.6 / (1 + STATUS_REST) < share <= 1.01 / (1 + STATUS_REST)


def test_no_request_waits_long_for_one_status_that_took_long(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(1.0, monkeypatch)
    asked.round(requests=1)
    asked.seconds = 1e-4
    for _ in range(40):
        asked.round(requests=1)
    assert asked.made[1] - asked.made[0] <= 1.0 + STATUS_INTERVAL + 2e-3 and asked.answers > 10


def test_nobody_asks_and_none_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(1e-3, monkeypatch)
    for _ in range(10):
        asked.round(requests=0)
    assert asked.made == []
