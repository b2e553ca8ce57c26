# SPDX-License-Identifier: MIT
"""Runs functions of the service thread while the loop stands still between two steps.

The loop is asked to stand still (`hold`), and does so once the step under way has ended. The service thread meanwhile
goes on with its rounds; as soon as it sees the loop stand still it runs what waits, and lets it go. So a step is late
by what these functions take, and its record says by how much; a paused loop stays paused.
"""

from collections import deque
from collections.abc import Callable

from sim_server.backends.base import LoopState


class BetweenSteps:
    """Functions that wait until the loop stands still. loop: memory shared with it"""

    def __init__(self, loop: LoopState):
        self._loop = loop
        self._waiting: deque[Callable[[], None]] = deque()
        self._requests = 0

    def add(self, change: Callable[[], None]) -> None:
        """Has a function run between two of the next steps."""
        self._waiting.append(change)
        if not self._loop.hold:
            self._requests += 1
            self._loop.hold = self._requests

    @property
    def waits(self) -> bool:
        """True if there are functions that wait."""
        return bool(self._waiting)

    @property
    def may_run(self) -> bool:
        """True if there are functions that wait and the loop stands still for them."""
        return self.waits and self._loop.held == self._loop.hold

    def run(self) -> None:
        """Runs all that waits, and lets the loop go. The loop must stand still, or have ended. They raise nothing."""
        try:
            while self._waiting:
                self._waiting.popleft()()
        finally:
            self._loop.hold = 0
