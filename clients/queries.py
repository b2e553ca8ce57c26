# SPDX-License-Identifier: MIT
"""Queries to one server, and which of the answers count.

Anybody who reaches the network may answer under the keys of a server. An answer counts if the incarnation in its header
is that of a server with a liveliness token; the first such server is kept until its token is gone. Answers of others,
malformed answers and missing ones neither change nor delay anything.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import zenoh
from google.protobuf.message import Message

from clients.errors import ClientError
from protocol.channels import CHANNELS, key, name_in
from protocol.refused import Refused
from protocol.validate import check_header, parse

M = TypeVar("M", bound=Message)
SECOND_SERVER_TIMEOUT = 0.3  # s for another live server of the same name to answer
TOKEN_PERIOD = 0.05  # s between two queries of the tokens
MAX_REPLIES = 256  # not read yet
MAX_SERVERS = 16  # incarnations whose answers are kept
MAX_OBJECTS = 4096  # answers kept of an incarnation


def send(
    session: zenoh.Session, server: str, channel: str, payload: bytes | None, timeout: float, handler: Any,
    names: Mapping[str, str] = {},
) -> Any:  # fmt: skip
    """Queries everybody who answers under a key; returns zenoh's handler, which gets each reply as it comes.

    names: parts of the key, as of `key`
    Without consolidation: by default zenoh holds the last reply of each key back until everybody has answered.
    """
    return session.get(
        key(channel, server, **names),
        handler,
        payload=payload,
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )


def read(reply: zenoh.Reply, channel: str, kind: type[M]) -> M:
    """Parses the message of a reply that is no error. Raises Refused."""
    assert reply.ok is not None
    message = parse(kind, reply.ok.payload, CHANNELS["reply" if channel == "command" else channel].limit)
    check_header(message)
    return message


@dataclass
class _Answers(Generic[M]):
    """The answers to one query so far: messages by incarnation and object, and the errors."""

    answers: dict[int, dict[str, M]] = field(default_factory=dict)
    error: str = ""  # of a reply without an answer, most likely the time-out
    malformed: str = ""  # why an answer could not be read

    def take(self, reply: zenoh.Reply, channel: str, kind: type[M]) -> int:
        """Adds a reply; returns the incarnation that answered, 0 for an error or a malformed answer."""
        if reply.ok is None:
            self.error = reply.err.payload.to_string() if reply.err else "an error"
            return 0
        try:
            message = read(reply, channel, kind)
        except Refused as error:
            self.malformed = str(error)
            return 0
        header = message.header  # type: ignore[attr-defined]
        if header.incarnation in self.answers or len(self.answers) < MAX_SERVERS:
            of = self.answers.setdefault(header.incarnation, {})
            if len(of) < MAX_OBJECTS:
                of.setdefault(header.object, message)
        return int(header.incarnation)

    def of(self, incarnation: int) -> list[M]:
        """Returns the messages of one incarnation."""
        return list(self.answers.get(incarnation, {}).values())


class Queries:
    """Queries the server `name`, reached at `where`. incarnation: of the server that is kept; 0: none yet."""

    def __init__(self, session: zenoh.Session, name: str, where: str):
        self._session, self._name, self._where = session, name, where
        self.incarnation = 0

    def ask(
        self, channel: str, kind: type[M], payload: bytes | None, timeout: float,
        complete: Callable[[list[M]], bool] = bool, names: Mapping[str, str] = {},
    ) -> list[M]:  # fmt: skip
        """Returns the server's answers once `complete` accepts them, at the time-out those that came.

        Empty if nobody answered. Raises ClientError.
        """
        found: _Answers[M] = _Answers()
        alive: set[int] = set()
        end, settled, next_tokens = time.monotonic() + timeout + TOKEN_PERIOD, math.inf, 0.0
        try:
            channel_of_replies: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(MAX_REPLIES)
            replies = send(self._session, self._name, channel, payload, timeout, channel_of_replies, names)
            while (reply := _next(replies, settled)) is not None:
                who, now = found.take(reply, channel, kind), time.monotonic()
                if who and who != self.incarnation:
                    if who not in alive and now >= next_tokens:
                        alive, next_tokens = self.alive(), now + TOKEN_PERIOD
                    if self.incarnation in alive or who not in alive:
                        continue
                    if len(alive) > 1:
                        settled = min(settled, now + SECOND_SERVER_TIMEOUT)
                        continue
                    self.incarnation = who
                if who and complete(found.of(who)):
                    return found.of(who)
            return self._decide(found, end)
        except zenoh.ZError as error:
            raise ClientError(f"lost the server {self._name!r} at {self._where}: {error}") from None

    def alive(self) -> set[int]:
        """Returns the incarnations of the servers of this name that have a liveliness token."""
        found: set[int] = set()
        for token in self._session.liveliness().get(key("alive_server", self._name), timeout=1.0):
            if token.ok is not None:
                with suppress(ValueError):  # also Refused
                    found.add(int(name_in("alive_server", token.ok.key_expr, "incarnation"), 16))
        return found - {0}  # 0 is no incarnation

    def _decide(self, found: _Answers[M], end: float) -> list[M]:
        """Returns the answers that count, when no more will come. Raises ClientError."""
        while found.answers and self.incarnation not in found.answers:
            alive = self.alive()
            if self.incarnation in alive:
                break
            live = [incarnation for incarnation in found.answers if incarnation in alive]
            if len(live) > 1:
                raise ClientError(
                    f"several servers are named {self._name!r} at {self._where}: "
                    f"{' and '.join(_title(i, found.of(i)) for i in live)}; stop one, or start it with another --name"
                )
            if live:
                self.incarnation = live[0]
            elif time.monotonic() > end:
                raise ClientError(
                    f"no server {self._name!r} at {self._where}: what answers in its name has no liveliness token"
                )
            else:
                time.sleep(TOKEN_PERIOD)  # a server that starts answers before it declares its token
        answers = found.of(self.incarnation)
        if not answers and (found.answers or found.error):
            why = f" ({found.error})" if found.error else ""
            raise ClientError(f"server {self._name!r} at {self._where} did not answer in time{why}")
        if not answers and found.malformed:
            raise ClientError(f"server {self._name!r} sent what this client does not understand: {found.malformed}")
        return answers


def _next(replies: zenoh.handlers.Handler[zenoh.Reply], until: float) -> zenoh.Reply | None:
    """Waits for the next reply; returns None once all have answered or timed out, or at `until`."""
    try:
        if until == math.inf:
            return replies.recv()
        while (reply := replies.try_recv()) is None and time.monotonic() < until:
            time.sleep(2e-3)
        return reply
    except zenoh.ZError:
        return None


def _title(incarnation: int, answers: Sequence[Message]) -> str:
    pid, scene = (getattr(answers[0], name, "") for name in ("pid", "scene"))
    return f"{incarnation:016x}" + (f" (process {pid}, {scene})" if pid else "")
