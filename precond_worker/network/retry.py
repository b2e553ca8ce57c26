# SPDX-License-Identifier: MIT
"""Repeats an attempt that failed, at growing intervals."""

import threading
from collections.abc import Callable

FIRST_DELAY = 1.0  # s; doubled after each attempt
ATTEMPTS = 8


class Retry:
    """Repeats at most one attempt at a time, in a thread of its own."""

    def __init__(self, first_delay: float = FIRST_DELAY) -> None:
        self._first_delay = first_delay
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, attempt: Callable[[], bool], on_success: Callable[[], None]) -> None:
        """Repeats `attempt` until it returns True, in place of the attempt before. on_success: called once then."""
        self.stop()
        ended = self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(attempt, on_success, ended), name="retry", daemon=True)
        self._thread.start()

    def _run(self, attempt: Callable[[], bool], on_success: Callable[[], None], ended: threading.Event) -> None:
        for k in range(ATTEMPTS):
            if ended.wait(self._first_delay * 2**k):
                return
            if attempt():
                with self._lock:
                    if not ended.is_set():
                        on_success()
                return

    def stop(self) -> None:
        """Ends the attempts; on_success is not called any more."""
        with self._lock:
            self._ended.set()

    def close(self) -> None:
        """Stops, and waits for an attempt that is running."""
        self.stop()
        if self._thread is not None:
            self._thread.join(5.0)
