# SPDX-License-Identifier: MIT
"""Ensures that a server is the only one of its name among the servers that it is linked with.

Anybody on the network may declare the token of a server, and the token of a dead server may outlive it by a moment. So
a name is taken only if a server answers to it. It is queried before this server declares its own token, and, since two
servers may start at the same instant and links are made in the background, for SETTLED seconds more.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence

import zenoh

from protocol.channels import DEFAULT_ENDPOINT, key
from protocol.messages_pb2 import Echo
from protocol.network.identity import Identity
from protocol.network.session import ConnectionFailed, Session, open_session
from protocol.shared_memory import probe as shm_probe
from sim_server.errors import NameTaken

log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 0.5  # s to reach the servers that this one is to be linked with; it goes on without them
SETTLED = 3.0  # s after which a server keeps its name against servers that start later
QUERY_INTERVAL = 0.5  # s


class NameClaim:
    """Raises NameTaken if another server has the name, at once or in `check`.

    Queries are sent by a client session to the servers in `connect`: a router does not forward them between servers.

    listen, connect, clock, tls: as of ServerLink
    """

    def __init__(
        self, session: Session, server: str, incarnation: int,
        listen: Sequence[str] | None, connect: Sequence[str] | None, clock: Callable[[], float] = time.monotonic,
        tls: Identity | None = None,
    ):  # fmt: skip
        self._server, self._incarnation, self._clock = server, incarnation, clock
        self._where = ", ".join(connect or listen or [DEFAULT_ENDPOINT])
        self._session, self._client = session, None if not connect else _client(connect, tls)
        self._since = float("inf")  # time of the first check [s, monotonic]: setting up may take long before it
        self._queried = float("-inf")  # time of the last query
        self._token_seen = False  # of another server of the name
        self._taken = self._warned = False
        if self._client is not None and self._query_and_wait():
            self.close()
            raise self._error()

    @property
    def settled(self) -> bool:
        """True once this server keeps its name for good."""
        return self._clock() - self._since > SETTLED

    @property
    def _query_session(self) -> zenoh.Session:
        return (self._client or self._session).zenoh

    def _query(self, answered: shm_probe.Answered) -> None:
        with contextlib.suppress(zenoh.ZError):  # the link was cut
            shm_probe.who(self._query_session, self._server, f"{self._incarnation:016x}", answered)

    def _query_and_wait(self) -> dict[int, Echo]:
        answers: dict[int, Echo] = {}
        done = threading.Event()

        def answered(found: dict[int, Echo]) -> None:
            answers.update(found)
            done.set()

        self._query(answered)
        done.wait(2.0)
        return answers

    def watch(self) -> None:
        """Watches for tokens of other servers of the name, from before this server declares its own."""
        tokens = key("alive_server", self._server)
        self._tokens = self._query_session.liveliness().declare_subscriber(tokens, self._on_token, history=True)

    def _on_token(self, sample: zenoh.Sample) -> None:
        own = f"{self._incarnation:016x}"
        if sample.kind == zenoh.SampleKind.PUT and not str(sample.key_expr).endswith(own):
            self._token_seen = True

    def check(self) -> None:
        """Raises NameTaken if this server has to leave; queries again while that is not known."""
        if self._taken:
            raise self._error()
        now = self._clock()
        self._since = min(self._since, now)
        if self._token_seen and now - self._queried > QUERY_INTERVAL:
            self._token_seen, self._queried = not self.settled, now
            self._query(self._compare)
        if self._client is not None and now - self._since > 2 * SETTLED:
            self.close()

    def _compare(self, found: dict[int, Echo]) -> None:
        """Decides which server leaves: of two that have just started the larger incarnation; never a settled one."""
        for incarnation, other in found.items():
            if incarnation == self._incarnation:
                continue
            if not self.settled:
                self._taken |= other.settled or incarnation < self._incarnation
            elif other.settled and not self._warned:
                self._warned = True
                log.warning("%s", self._error())

    def _error(self) -> NameTaken:
        return NameTaken(
            f"another sim-server called {self._server!r} answers at {self._where}; --name gives this one a name of its "
            "own, and --server names it to its workers and clients"
        )

    def close(self) -> None:
        """Ends the queries."""
        client, self._client = self._client, None
        if client is not None:
            client.close()


def _client(connect: Sequence[str], tls: Identity | None) -> Session | None:
    try:
        return open_session("client", connect=connect, shared_memory=False, timeout=CONNECT_TIMEOUT, tls=tls)
    except ConnectionFailed:
        return None
