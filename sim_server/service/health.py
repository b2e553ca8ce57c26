# SPDX-License-Identifier: MIT
"""Whether the loop goes on: for the watchdog of systemd and for probes (/healthy)."""

import time
from collections.abc import Callable

from protocol.process.notify import Notifier

STUCK = 60.0  # s without a step after which a server that should make steps is not healthy


class Health:
    """Is told of the loop in each round of the service thread. notifier: whose watchdog is fed while it goes on"""

    def __init__(self, notifier: Notifier, clock: Callable[[], float] = time.monotonic):
        self.notifier, self._clock = notifier, clock
        self._step, self._alive = -1, clock()

    def look(self, step: int, stands: bool) -> None:
        """Notes the steps completed. stands: the loop is to make none now"""
        if stands or step != self._step:
            self._step, self._alive = step, self._clock()
            self.notifier.alive()

    def why_not(self) -> str:
        """Returns why the server is not healthy; empty if it is. From any thread."""
        since = self._clock() - self._alive
        return f"no step was completed for {since:.0f} s" if since > STUCK else ""
