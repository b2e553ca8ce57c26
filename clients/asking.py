# SPDX-License-Identifier: MIT
"""Questions to one server, and whose answers count.

Anybody who reaches the network may answer under the keys of a server. An answer counts if the incarnation in its header
is that of a server whose liveliness token is there; the first such server is kept until its token is gone. Other
answers, answers that cannot be read and those who do not answer at all change nothing and delay nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import zenoh
from google.protobuf.message import Message

from clients.errors import ClientError
from protocol import Refused
from protocol.channels import CHANNELS, key, name_in
from protocol.check import check_header, parse

M = TypeVar("M", bound=Message)
OTHERS_ANSWER = 0.3  # s that another live server of the same name has to answer, too
LOOK_AGAIN = 0.05  # s between two looks at the tokens
REPLIES = 256  # that wait to be read
SERVERS = 16  # incarnations whose answers are kept
OBJECTS = 4096  # answers of an incarnation that are kept


def send(session: zenoh.Session, server: str, channel: str, payload: bytes | None, timeout: float, handler: Any) -> Any:
    """Asks all who answer under a key; returns zenoh's handler, which gets each reply as it comes (by default zenoh
    would keep the last one of each key back until everybody has answered)."""
    return session.get(
        key(channel, server),
        handler,
        payload=payload,
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )


def read(reply: zenoh.Reply, channel: str, kind: type[M]) -> M:
    """The message of a reply that is none of an error. Raises Refused."""
    assert reply.ok is not None
    message = parse(kind, reply.ok.payload, CHANNELS["reply" if channel == "command" else channel].limit)
    check_header(message)
    return message


@dataclass
class _Found(Generic[M]):
    """What one question has brought so far: messages by incarnation and object, and what else came."""

    answers: dict[int, dict[str, M]] = field(default_factory=dict)
    silent: str = ""  # an error instead of an answer, most likely the time-out
    garbage: str = ""  # why an answer could not be read

    def take(self, reply: zenoh.Reply, channel: str, kind: type[M]) -> int:
        """The incarnation that answered, 0 if it was no answer."""
        if reply.ok is None:
            self.silent = reply.err.payload.to_string() if reply.err else "an error"
            return 0
        try:
            message = read(reply, channel, kind)
        except Refused as error:
            self.garbage = str(error)
            return 0
        header = message.header  # type: ignore[attr-defined]
        if header.incarnation in self.answers or len(self.answers) < SERVERS:
            of = self.answers.setdefault(header.incarnation, {})
            if len(of) < OBJECTS:
                of.setdefault(header.object, message)
        return int(header.incarnation)

    def of(self, incarnation: int) -> list[M]:
        """Messages of one incarnation."""
        return list(self.answers.get(incarnation, {}).values())


class Asking:
    """Asks the server `name`, reached at `where`. incarnation: of the server that is kept, 0: none yet."""

    def __init__(self, session: zenoh.Session, name: str, where: str):
        self._session, self._name, self._where = session, name, where
        self.incarnation = 0

    def ask(
        self, channel: str, kind: type[M], payload: bytes | None, timeout: float,
        complete: Callable[[list[M]], bool] = bool,
    ) -> list[M]:  # fmt: skip
        """The server's answers as soon as they are complete, or what came of them; none if nobody answered.

        Raises ClientError.
        """
        found: _Found[M] = _Found()
        alive: set[int] = set()
        end, settled, look = time.monotonic() + timeout + LOOK_AGAIN, math.inf, 0.0
        try:
            room: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(REPLIES)
            replies = send(self._session, self._name, channel, payload, timeout, room)
            while (reply := _next(replies, settled)) is not None:
                who, now = found.take(reply, channel, kind), time.monotonic()
                if who and who != self.incarnation:
                    if who not in alive and now >= look:
                        alive, look = self.alive(), now + LOOK_AGAIN
                    if self.incarnation in alive or who not in alive:
                        continue
                    if len(alive) > 1:
                        settled = min(settled, now + OTHERS_ANSWER)
                        continue
                    self.incarnation = who
                if who and complete(found.of(who)):
                    return found.of(who)
            return self._at_last(found, end)
        except zenoh.ZError as error:
            raise ClientError(f"lost the server {self._name!r} at {self._where}: {error}") from None

    def alive(self) -> set[int]:
        """Incarnations of the servers of this name whose tokens are there."""
        found: set[int] = set()
        for token in self._session.liveliness().get(key("alive_server", self._name), timeout=1.0):
            if token.ok is not None:
                with suppress(ValueError):  # also Refused
                    found.add(int(name_in("alive_server", token.ok.key_expr, "incarnation"), 16))
        return found - {0}  # no incarnation

    def _at_last(self, found: _Found[M], end: float) -> list[M]:
        """What to make of the answers when no more will come."""
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
                time.sleep(LOOK_AGAIN)  # a server that starts answers before its token is there
        answers = found.of(self.incarnation)
        if not answers and (found.answers or found.silent):
            why = f" ({found.silent})" if found.silent else ""
            raise ClientError(f"server {self._name!r} at {self._where} did not answer in time{why}")
        if not answers and found.garbage:
            raise ClientError(f"server {self._name!r} sent what this client does not understand: {found.garbage}")
        return answers


def _next(replies: zenoh.handlers.Handler[zenoh.Reply], until: float) -> zenoh.Reply | None:
    """The next reply; None once all have answered or timed out, or at `until`."""
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
