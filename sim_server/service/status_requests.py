# SPDX-License-Identifier: MIT
"""Answers clients that ask for a status."""

import time
from collections.abc import Callable

from protocol.messages_pb2 import Reply

REST = 3  # times that a status took until the next one, so that a quarter of the time goes into them
INTERVAL = 0.02  # s of that at most


class StatusRequests:
    """Has one status made for all requests since the last: it costs more than any other command.

    make: makes and publishes a status
    clock: monotonic time [s]
    """

    def __init__(self, make: Callable[[], None], clock: Callable[[], float] = time.monotonic):
        self._make, self._clock = make, clock
        self._replies: list[Callable[[Reply], None]] = []
        self._due = float("-inf")

    def add(self, reply: Callable[[Reply], None]) -> None:
        """Takes note of a request. reply: called once the status is published"""
        self._replies.append(reply)

    def answer(self) -> None:
        """Has a status made if somebody waits for one and it is due."""
        if not self._replies or (begin := self._clock()) < self._due:
            return
        self._make()
        end = self._clock()
        self._due = end + min(REST * (end - begin), INTERVAL)
        replies, self._replies = self._replies, []
        for reply in replies:
            reply(Reply())
