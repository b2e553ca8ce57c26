# SPDX-License-Identifier: MIT
"""How often a server makes a status because clients ask for one."""

import itertools

import pytest

from protocol import messages_pb2 as pb
from sim_server.service.status_requests import INTERVAL, LATE, REST, StatusRequests


class Asked:
    """Requests for statuses, with a clock of their own.

    seconds: that a status takes. fetch: that places of objects take. made: when statuses were made [s]; of the same,
    whether with places
    """

    def __init__(self, seconds: float, fetch: float = 0.0):
        self.now, self.seconds, self.fetch, self.answers = 0.0, seconds, fetch, 0
        self.made: list[float] = []
        self.with_places: list[bool] = []
        self._fetched = -1.0  # when the places are there; below 0: nobody fetches them
        self._requests = StatusRequests(self._make, self._ready, lambda: self.now)

    def _ready(self) -> bool:
        self._fetched = self.now + self.fetch if self._fetched < 0 else self._fetched
        return self.now >= self._fetched

    def _make(self, where: bool) -> None:
        self.made.append(self.now)
        self.with_places.append(where)
        if where:
            self._fetched = -1.0
        self.now += self.seconds

    def _answer(self, reply: pb.Reply) -> None:
        assert not reply.error
        self.answers += 1

    def round(self, requests: int, rest: float = 1e-3) -> None:
        """One round of the service thread, after which it sleeps."""
        for _ in range(requests):
            self._requests.add(self._answer)
        self._requests.answer()
        self.now += rest


def test_a_cheap_status_is_made_in_the_round_of_its_request() -> None:
    asked = Asked(2e-4)
    for _ in range(50):
        asked.round(requests=3)
    assert asked.answers == 150 and len(asked.made) == 50


@pytest.mark.parametrize("seconds", [1e-3, 4e-3])
def test_statuses_take_a_quarter_of_the_time_however_many_ask(seconds: float) -> None:
    asked = Asked(seconds)
    for _ in range(2000):
        asked.round(requests=10)
    share = len(asked.made) * seconds / asked.now
    assert 0.6 / (1 + REST) < share <= 1.01 / (1 + REST)


def test_no_request_waits_long_for_one_status_that_took_long() -> None:
    asked = Asked(1.0)
    asked.round(requests=1)
    asked.seconds = 1e-4
    for _ in range(40):
        asked.round(requests=1)
    assert asked.made[1] - asked.made[0] <= 1.0 + INTERVAL + 2e-3 and asked.answers > 10


def test_nobody_asks_and_none_is_made() -> None:
    asked = Asked(1e-3)
    for _ in range(10):
        asked.round(requests=0)
    assert asked.made == []


def test_a_status_has_the_places_that_come_soon() -> None:
    asked = Asked(1e-4, fetch=3e-3)
    for _ in range(20):
        asked.round(requests=1)
    assert all(asked.with_places) and len(asked.made) > 3


def test_while_a_device_is_busy_a_status_comes_without_places_and_later_with_them() -> None:
    """As while another thread allocates memory that a GPU reads."""
    asked = Asked(1e-4, fetch=0.1)
    asked.round(requests=1)
    while not asked.made:
        asked.round(requests=0)
    assert asked.with_places == [False] and asked.made[0] <= LATE + 2e-3 and asked.answers == 1
    for _ in range(100):
        asked.round(requests=1)
    gaps = [later - sooner for sooner, later in itertools.pairwise(asked.made)]
    assert True in asked.with_places and max(gaps) <= LATE + INTERVAL + 2e-3
