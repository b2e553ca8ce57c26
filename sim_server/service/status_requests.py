# SPDX-License-Identifier: MIT
"""Answers clients that ask for a status."""

import time
from collections.abc import Callable

from protocol.messages_pb2 import Reply

REST = 3  # times that a status took until the next one, so that a quarter of the time goes into them
INTERVAL = 0.02  # s of that at most
LATE = 0.01  # s for which a status waits for the places of objects, at most; then it is made without


class StatusRequests:
    """Has one status made for all requests since the last: it costs more than any other command.

    make: makes and publishes a status, with the places of objects or without
    ready: begins to fetch these places, if nobody did, and tells whether they are there
    clock: monotonic time [s]
    """

    def __init__(
        self, make: Callable[[bool], None], ready: Callable[[], bool], clock: Callable[[], float] = time.monotonic
    ):
        self._make, self._ready, self._clock = make, ready, clock
        self._late: float | None = None  # when the status that is wanted is made without places
        self._replies: list[Callable[[Reply], None]] = []
        self._due = float("-inf")

    def add(self, reply: Callable[[Reply], None]) -> None:
        """Takes note of a request. reply: called once the status is published"""
        self._replies.append(reply)

    def answer(self) -> None:
        """Has a status made if somebody waits for one and it is due."""
        if not self._replies or (begin := self._clock()) < self._due:
            return
        self._late = begin + LATE if self._late is None else self._late
        ready = self._ready()
        if not ready and begin < self._late:
            return
        self._late = None
        self._make(ready)
        end = self._clock()
        self._due = end + min(REST * (end - begin), INTERVAL)
        replies, self._replies = self._replies, []
        for reply in replies:
            reply(Reply())
