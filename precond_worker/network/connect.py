# SPDX-License-Identifier: MIT
"""Sessions to servers, opened as soon as the servers are there."""

import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence

from precond_worker.network.server_addresses import ServerAddress
from protocol.network.identity import Identity
from protocol.network.session import ConnectionFailed, Session, open_session

TIMEOUT = 1.0  # s of one attempt


def connect_session(
    connect: Sequence[str], shared_memory: bool, ended: threading.Event | None = None, tls: Identity | None = None
) -> Session:
    """Opens a session to the server; retries until it is there, and prints each failure once. Raises BadEndpoint.

    ended: set to give up, which raises the last ConnectionFailed.
    """
    reported: set[str] = set()
    while True:
        try:
            return open_session("client", connect=connect, shared_memory=shared_memory, timeout=TIMEOUT, tls=tls)
        except ConnectionFailed as failure:
            if ended is not None and ended.wait(0.05):
                raise
            if str(failure) not in reported:  # it may be refused once it is there
                print(f"precond-worker: {failure}; trying until the server is there", file=sys.stderr, flush=True)
            reported.add(str(failure))


class Connector:
    """Connects to several addresses at once, each in a thread of its own; sets `wake` when one is reached."""

    def __init__(
        self, addresses: Sequence[ServerAddress], shared_memory: bool, wake: threading.Event,
        tls: Identity | None = None,
    ):  # fmt: skip
        self._shared_memory, self._wake, self._tls = shared_memory, wake, tls
        self._ended = threading.Event()
        self._reached: deque[tuple[ServerAddress, Session]] = deque()
        self._sessions: list[Session] = []
        self._threads = [threading.Thread(target=self._connect, args=(address,), daemon=True) for address in addresses]
        for thread in self._threads:
            thread.start()

    def _connect(self, address: ServerAddress) -> None:
        try:
            session = connect_session(address.endpoints, self._shared_memory, self._ended, self._tls)
        except ConnectionFailed:
            return
        self._sessions.append(session)
        self._reached.append((address, session))
        self._wake.set()

    def reached(self) -> Iterator[tuple[ServerAddress, Session]]:
        """Yields the addresses reached since the last call, with their sessions."""
        while self._reached:
            yield self._reached.popleft()

    def close(self) -> None:
        """Stops the attempts and closes the sessions."""
        self._ended.set()
        for thread in self._threads:
            thread.join(TIMEOUT + 2)
        for session in self._sessions:
            session.close()
