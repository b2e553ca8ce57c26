# SPDX-License-Identifier: MIT
"""A question that is asked again when the answer was no, since it may have been asked at a bad moment."""

import threading
from collections.abc import Callable

FIRST = 1.0  # s until it is asked again, doubled each time ...
TIMES = 8  # ... and so often


class Again:
    """At most one question at a time, asked from a thread of its own."""

    def __init__(self, first: float = FIRST) -> None:
        self._first = first
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def ask(self, question: Callable[[], bool], then: Callable[[], None]) -> None:
        """From now on, in place of what was asked so far. then: called once, if the answer is yes."""
        self.stop()
        ended = self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(question, then, ended), name="again", daemon=True)
        self._thread.start()

    def _run(self, question: Callable[[], bool], then: Callable[[], None], ended: threading.Event) -> None:
        for k in range(TIMES):
            if ended.wait(self._first * 2**k):
                return
            if question():
                with self._lock:
                    if not ended.is_set():
                        then()
                return

    def stop(self) -> None:
        """Nothing is asked any more, and `then` not called."""
        with self._lock:
            self._ended.set()

    def close(self) -> None:
        """Stop, and wait for a question that is being asked."""
        self.stop()
        if self._thread is not None:
            self._thread.join(5.0)
