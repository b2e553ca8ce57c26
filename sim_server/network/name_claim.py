# SPDX-License-Identifier: MIT
"""The name of a server among those that it is linked with: there is one server of a name.

Anybody on the network may declare the token of a server, and that of a dead one may outlive it by a moment. So a name
is taken only if a server answers to it. It is asked for before this server shows itself, and, since two may start at
the same instant and links are made in the background, for SETTLED seconds more.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Sequence

import zenoh

from protocol import echo
from protocol.channels import DEFAULT_ENDPOINT, key
from protocol.messages_pb2 import Echo
from protocol.session import ConnectionFailed, Session, open_session
from sim_server.errors import NameTaken

log = logging.getLogger(__name__)

LINKING = 0.5  # s to reach those that this server is to be linked with; without them it goes on
SETTLED = 3.0  # s after which a server leaves no more; whoever comes later has to
AGAIN = 0.5  # s between questions


class NameClaim:
    """Says whether a server may keep its name; raises NameTaken at once if it may not.

    listen, connect: as of ServerLink. Asks as a client of those that this server is linked with: a router tells one
    server nothing of another.
    """

    def __init__(
        self, session: Session, server: str, incarnation: int,
        listen: Sequence[str] | None, connect: Sequence[str] | None,
    ):  # fmt: skip
        self._server, self._incarnation = server, incarnation
        self._where = ", ".join(connect or listen or [DEFAULT_ENDPOINT])
        self._session, self._client = session, None if not connect else _client(connect)
        self._since = float("inf")  # when [s, monotonic] it was checked first: setting up may take long before that
        self._asked = float("-inf")
        self._met = False  # a token of another server of the name was seen
        self._taken = self._warned = False
        if self._client is not None and self._ask_and_wait():
            self.close()
            raise self._error()

    @property
    def settled(self) -> bool:
        """The name is this server's."""
        return time.monotonic() - self._since > SETTLED

    @property
    def _asking(self) -> zenoh.Session:
        return (self._client or self._session).zenoh

    def _ask(self, answered: echo.Answered) -> None:
        with contextlib.suppress(zenoh.ZError):  # the link was cut: there is nobody to be told of
            echo.who(self._asking, self._server, f"{self._incarnation:016x}", answered)

    def _ask_and_wait(self) -> dict[int, Echo]:
        answers: dict[int, Echo] = {}
        done = threading.Event()

        def answered(found: dict[int, Echo]) -> None:
            answers.update(found)
            done.set()

        self._ask(answered)
        done.wait(2.0)
        return answers

    def begin(self) -> None:
        """The name is taken; hear of others that take it."""
        tokens = key("alive_server", self._server)
        self._tokens = self._asking.liveliness().declare_subscriber(tokens, self._token, history=True)

    def _token(self, sample: zenoh.Sample) -> None:
        own = f"{self._incarnation:016x}"
        if sample.kind == zenoh.SampleKind.PUT and not str(sample.key_expr).endswith(own):
            self._met = True

    def check(self) -> None:
        """Raise NameTaken if this server has to leave; ask again where that is not known yet."""
        if self._taken:
            raise self._error()
        now = time.monotonic()
        self._since = min(self._since, now)
        if self._met and now - self._asked > AGAIN:
            self._met, self._asked = not self.settled, now
            self._ask(self._compare)
        if self._client is not None and now - self._since > 2 * SETTLED:
            self.close()

    def _compare(self, found: dict[int, Echo]) -> None:
        """Of two that have just started the larger incarnation leaves; one that is settled stays."""
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
        """Ask no more."""
        client, self._client = self._client, None
        if client is not None:
            client.close()


def _client(connect: Sequence[str]) -> Session | None:
    try:
        return open_session("client", connect=connect, shared_memory=False, timeout=LINKING)
    except ConnectionFailed:
        return None
