# SPDX-License-Identifier: MIT
"""Which lives of its server a worker hears of: those that answer, and the one whose token vanished.

Anybody on the network may declare the token of a server. So a token that comes is only a reason to ask who is there. A
worker leaves the life that it serves when the token of that life is gone, or when that life answers no more and another
one does.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from protocol import echo
from protocol.channels import PROTOCOL, key, name_in
from protocol.counters import Counters
from protocol.messages_pb2 import Echo
from protocol.refused import Refused

SOON = 0.1  # s at least between two questions
AGAIN = 1.0  # s between questions while nobody answers
KNOWN = 1024  # tokens of servers
TOLD = 16  # servers of another wire version that are told of


@dataclass(frozen=True)
class ServerGone:
    """The token of this life of the server vanished."""

    incarnation: int


@dataclass(frozen=True)
class ServersThere:
    """These lives of the server answered a question, all that did."""

    incarnations: tuple[int, ...]


class Presence:
    """Asks who is there whenever a token came or went, and again until the life that is served has answered.

    heard: is called in threads of zenoh's with what was found. wake: makes the thread that calls `look` do so now.
    """

    def __init__(
        self, session: zenoh.Session, server: str, worker: str, counters: Counters,
        heard: Callable[[ServerGone | ServersThere], None], wake: Callable[[], None],
    ):  # fmt: skip
        self.serving = 0  # incarnation that the worker works for; 0: none
        self._session, self._server, self._worker, self._counters = session, server, worker, counters
        self._heard, self._wake = heard, wake
        self._stirred = False  # a token came or went since the last question
        self._answered = 0  # the life served, once it has answered; 0: since the last token it has not
        self._considered = 0  # the life whose token was looked for last
        self._asked = float("-inf")  # when [s, monotonic]
        self._known: dict[int, None] = {}  # lives with a token, the oldest first, as far as they fit
        self._told: set[int] = set()

    def begin(self) -> None:
        """Hear of tokens from now on, and of those that are there."""
        self._tokens = self._session.liveliness().declare_subscriber(
            key("alive_server", self._server), self._token, history=True
        )

    def _token(self, sample: zenoh.Sample) -> None:
        try:
            incarnation = int(name_in("alive_server", sample.key_expr, "incarnation"), 16)
        except ValueError as error:
            self._counters.refuse(error if isinstance(error, Refused) else Refused(f"{sample.key_expr}: {error}"))
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._known[incarnation] = None
            if len(self._known) > KNOWN:
                self._known.pop(next(iter(self._known)))
        else:
            self._known.pop(incarnation, None)
            if incarnation in (self.serving, self._considered):
                self._heard(ServerGone(incarnation))
        self._answered = 0
        self._stirred = True
        self._wake()

    def look(self) -> None:
        """Ask who is there if it is time to; does not wait for the answers."""
        now = time.monotonic()
        sure = self.serving and self.serving == self._answered
        if not sure and now - self._asked >= (SOON if self._stirred else AGAIN):
            self._stirred, self._asked = False, now
            echo.who(self._session, self._server, self._worker, self._take)

    def _take(self, found: dict[int, Echo]) -> None:
        versions = {incarnation: answer.header.protocol for incarnation, answer in found.items()}
        ours = tuple(incarnation for incarnation, version in versions.items() if version == PROTOCOL)
        if self.serving in ours:
            if not self._stirred:
                self._answered = self.serving
        elif ours:
            self._heard(ServersThere(ours))
        for incarnation, version in versions.items():
            if version != PROTOCOL and incarnation not in self._told and len(self._told) < TOLD:
                self._told.add(incarnation)
                self._counters.warn(
                    f"version:{incarnation}",
                    f"server {self._server} speaks protocol version {version}, this worker version {PROTOCOL}: it is "
                    "not served; install the same release of warpfactor on both sides",
                )

    def has_token(self, incarnation: int) -> bool:
        """That life of the server has a token; if it is none of those known, waits for the answer of the router."""
        self._considered = incarnation
        if incarnation in self._known:
            return True
        name = key("alive_server", self._server, incarnation=f"{incarnation:016x}")
        return any(reply.ok is not None for reply in self._session.liveliness().get(name, timeout=1.0))
