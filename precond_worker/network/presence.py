# SPDX-License-Identifier: MIT
"""Which incarnations of a server are alive: those that answer a query, until their liveliness token is gone.

Anybody on the network may declare the token of a server, so that a new token only causes a query. A worker leaves the
incarnation that it serves when the token of that one is gone, or when it answers no more and another one does.
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from protocol.channels import PROTOCOL, key, name_in
from protocol.counters import Counters
from protocol.messages_pb2 import Echo
from protocol.refused import Refused
from protocol.shared_memory import probe as shm_probe

MIN_PERIOD = 0.1  # s between two queries after a change of tokens
PERIOD = 1.0  # s between two queries while the server does not answer
MAX_TOKENS = 1024  # of servers, kept
MAX_WARNINGS = 16  # of servers of another wire version


@dataclass(frozen=True)
class ServerGone:
    """The token of this incarnation of the server is gone."""

    incarnation: int


@dataclass(frozen=True)
class ServersThere:
    """All incarnations of the server that answered a query."""

    incarnations: tuple[int, ...]


class Presence:
    """Queries the server whenever a token came or went, and again until the incarnation that is served has answered.

    heard: called with the result in threads of zenoh's. wake: makes the thread that calls `look` do so at once.
    """

    def __init__(
        self, session: zenoh.Session, server: str, worker: str, counters: Counters,
        heard: Callable[[ServerGone | ServersThere], None], wake: Callable[[], None],
    ):  # fmt: skip
        self.serving = 0  # incarnation that is served; 0: none
        self._session, self._server, self._worker, self._counters = session, server, worker, counters
        self._heard, self._wake = heard, wake
        self._changed = False  # a token came or went since the last query
        self._answered = 0  # the incarnation served, if it has answered since the last token; else 0
        self._candidate = 0  # the incarnation whose token was looked for last
        self._asked = float("-inf")  # time of the last query [s, monotonic]
        self._known: dict[int, None] = {}  # incarnations with a token, the oldest first
        self._warned: set[int] = set()

    def begin(self) -> None:
        """Subscribes to tokens, present and future ones."""
        self._tokens = self._session.liveliness().declare_subscriber(
            key("alive_server", self._server), self._token, history=True
        )

    def end(self) -> None:
        """Hears no more tokens."""
        with contextlib.suppress(zenoh.ZError):
            self._tokens.undeclare()

    def _token(self, sample: zenoh.Sample) -> None:
        try:
            incarnation = int(name_in("alive_server", sample.key_expr, "incarnation"), 16)
        except ValueError as error:
            self._counters.refuse(error if isinstance(error, Refused) else Refused(f"{sample.key_expr}: {error}"))
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._known[incarnation] = None
            if len(self._known) > MAX_TOKENS:
                self._known.pop(next(iter(self._known)))
        else:
            self._known.pop(incarnation, None)
            if incarnation in (self.serving, self._candidate):
                self._heard(ServerGone(incarnation))
        self._answered = 0
        self._changed = True
        self._wake()

    def look(self) -> None:
        """Queries the server if it is time to; does not wait for the answers."""
        now = time.monotonic()
        sure = self.serving and self.serving == self._answered
        if not sure and now - self._asked >= (MIN_PERIOD if self._changed else PERIOD):
            self._changed, self._asked = False, now
            shm_probe.who(self._session, self._server, self._worker, self._take)

    def _take(self, found: dict[int, Echo]) -> None:
        versions = {incarnation: answer.header.protocol for incarnation, answer in found.items()}
        ours = tuple(incarnation for incarnation, version in versions.items() if version == PROTOCOL)
        if self.serving in ours:
            if not self._changed:
                self._answered = self.serving
        elif ours:
            self._heard(ServersThere(ours))
        for incarnation, version in versions.items():
            if version != PROTOCOL and incarnation not in self._warned and len(self._warned) < MAX_WARNINGS:
                self._warned.add(incarnation)
                self._counters.warn(
                    f"version:{incarnation}",
                    f"server {self._server} speaks protocol version {version}, this worker version {PROTOCOL}: it is "
                    "not served; install the same release of warpfactor on both sides",
                )

    def has_token(self, incarnation: int) -> bool:
        """True if that incarnation has a token; waits for the router's answer if the token is not known."""
        self._candidate = incarnation
        if incarnation in self._known:
            return True
        name = key("alive_server", self._server, incarnation=f"{incarnation:016x}")
        return any(reply.ok is not None for reply in self._session.liveliness().get(name, timeout=1.0))
