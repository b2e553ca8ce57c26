# SPDX-License-Identifier: MIT
"""Getting to the servers, however long it takes."""

import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence

from precond_worker.places import Place
from protocol.session import ConnectionFailed, Session, open_session

ATTEMPT = 1.0  # s


def join(connect: Sequence[str], shared_memory: bool, ended: threading.Event | None = None) -> Session:
    """A session to the server; while it is not there yet this says so once and tries on. Raises BadEndpoint.

    ended: set to give up, with the last ConnectionFailed.
    """
    said = False
    while True:
        try:
            return open_session("client", connect=connect, shared_memory=shared_memory, timeout=ATTEMPT)
        except ConnectionFailed as failure:
            if ended is not None and ended.wait(0.05):
                raise
            if not said:
                print(f"precond-worker: {failure}; trying until the server is there", file=sys.stderr, flush=True)
            said = True


class Joining:
    """Joins several places at once, each in a thread of its own; `bell` is set when one is reached."""

    def __init__(self, places: Sequence[Place], shared_memory: bool, bell: threading.Event):
        self._shared_memory, self._bell = shared_memory, bell
        self._ended = threading.Event()
        self._reached: deque[tuple[Place, Session]] = deque()
        self._sessions: list[Session] = []
        self._threads = [threading.Thread(target=self._join, args=(place,), daemon=True) for place in places]
        for thread in self._threads:
            thread.start()

    def _join(self, place: Place) -> None:
        try:
            session = join(place.endpoints, self._shared_memory, self._ended)
        except ConnectionFailed:
            return
        self._sessions.append(session)
        self._reached.append((place, session))
        self._bell.set()

    def reached(self) -> Iterator[tuple[Place, Session]]:
        """Places reached since the last time."""
        while self._reached:
            yield self._reached.popleft()

    def close(self) -> None:
        """Stop trying, close what was opened."""
        self._ended.set()
        for thread in self._threads:
            thread.join(ATTEMPT + 2)
        for session in self._sessions:
            session.close()
