# SPDX-License-Identifier: MIT
"""Hello and heartbeats, sent from a thread of its own."""

import logging
import threading
from collections.abc import Callable

import zenoh

log = logging.getLogger(__name__)

PERIOD = 0.2  # s


class Heartbeat:
    """Calls `beat` every PERIOD seconds, and at once after `wake`."""

    def __init__(self, beat: Callable[[], None]):
        self._beat = beat
        self._woken = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Beats at once, as the state has changed."""
        self._woken.set()

    def _run(self) -> None:
        while not self._ended.is_set():
            self._woken.wait(PERIOD)
            self._woken.clear()
            try:
                self._beat()
            except zenoh.ZError as error:
                log.debug("no heartbeat: %s", error)

    def close(self) -> None:
        """Ends the thread."""
        self._ended.set()
        self._woken.set()
        self._thread.join(1.0)
