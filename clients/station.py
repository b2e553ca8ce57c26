# SPDX-License-Identifier: MIT
"""A server without a simulation: answers, publishes, takes commands. What a replay stands behind."""

from __future__ import annotations

import logging
import secrets
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any, Self

import zenoh

from clients.errors import BadInput, ClientError
from protocol import PROTOCOL, Refused
from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, DEFAULT_ENDPOINT, check_name, everything, key
from protocol.check import check_header, parse
from protocol.endpoints import BadEndpoint
from protocol.session import ConnectionFailed, Session, open_session

log = logging.getLogger(__name__)

COMMANDS = 64  # that may wait; beyond that they are turned away
PATIENCE = 1.0  # s for the question who is there


class Station:
    """On the network as server `name`; a context manager.

    name: if somebody has it, a ClientError; None: `otherwise`, or that with a suffix if somebody has it. connect: a hub
    to join; listen: endpoints of a hub of our own; neither: our own on the default port, or the one that is there.
    """

    def __init__(
        self, name: str | None, otherwise: str, connect: Sequence[str] | None, listen: Sequence[str] | None
    ) -> None:
        self.incarnation = secrets.randbits(63) | 1
        self._sequence: Counter[str] = Counter()
        self._answers: dict[str, bytes] = {}
        self._commands: deque[zenoh.Query] = deque()
        try:
            wanted = check_name(otherwise if name is None else name, "server name")
            self._session, self.where = _joined(connect, listen)
        except (Refused, BadEndpoint) as error:
            raise BadInput(str(error)) from None
        try:
            self.name = self._free(wanted, name is not None)
            self._zenoh = self._session.zenoh
            self._queryable = self._zenoh.declare_queryable(everything(self.name), self._serve)
            self._token = self._zenoh.liveliness().declare_token(
                key("alive_server", self.name, incarnation=f"{self.incarnation:016x}")
            )
        except BaseException:
            self.close()
            raise

    def offer(self, channel: str, message: Any, **names: str) -> None:
        """What questions for a key are answered with from now on."""
        self._stamp(channel, message)
        self._answers[key(channel, self.name, **names)] = message.SerializeToString()

    def put(self, channel: str, message: Any, wait: bool = False, **names: str) -> None:
        """Sends to whoever listens; wait: for the slowest of them, instead of leaving things out."""
        self._stamp(channel, message)
        control = zenoh.CongestionControl.BLOCK if wait else zenoh.CongestionControl.DROP
        self._zenoh.put(key(channel, self.name, **names), message.SerializeToString(), congestion_control=control)

    def commands(self) -> list[tuple[str, zenoh.Query]]:
        """Verbs that came since the last call, each to be given to `answer`."""
        found = []
        while self._commands:
            query = self._commands.popleft()
            try:
                command = parse(pb.Command, query.payload, CHANNELS["command"].limit)
                check_header(command)
                found.append((command.verb, query))
            except Refused as error:
                self.answer(query, pb.Reply(error=str(error)))
        return found

    def answer(self, query: zenoh.Query, reply: pb.Reply) -> None:
        """To one command."""
        self._stamp("reply", reply)
        try:
            query.reply(key("command", self.name), reply.SerializeToString())
        except zenoh.ZError as error:
            log.debug("a command was not answered: %s", error)
        finally:
            query.drop()

    def close(self) -> None:
        """Leaves the network."""
        while self._commands:
            self._commands.popleft().drop()
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stamp(self, channel: str, message: Any) -> None:
        self._sequence[channel] += 1
        message.header.protocol, message.header.incarnation = PROTOCOL, self.incarnation
        message.header.sequence = self._sequence[channel]

    def _free(self, wanted: str, asked: bool) -> str:
        names = [wanted, f"{wanted}-replay", *(f"{wanted}-replay-{k}" for k in range(2, 10))]
        for name in names[:1] if asked else names:
            if len(name) <= 64 and not self._taken(name):
                return name
        which = f"a live server {wanted!r} is" if asked else f"live servers {wanted!r}, {names[1]!r} and more are"
        raise ClientError(f"{which} at {self.where}: --name gives the replay another name")

    def _taken(self, name: str) -> bool:
        tokens = self._session.zenoh.liveliness().get(key("alive_server", name), timeout=PATIENCE)
        return any(token.ok is not None for token in tokens)

    def _serve(self, query: zenoh.Query) -> None:
        if str(query.key_expr) == key("command", self.name):
            if len(self._commands) < COMMANDS:
                self._commands.append(query)
            else:
                self.answer(query, pb.Reply(error=f"the replay is busy: {COMMANDS} commands wait already"))
            return
        with query:
            for name, data in list(self._answers.items()):
                if query.key_expr.intersects(zenoh.KeyExpr(name)):
                    query.reply(name, data)


def _joined(connect: Sequence[str] | None, listen: Sequence[str] | None) -> tuple[Session, str]:
    """A session and where it is: a hub of its own, or the one that is there."""
    try:
        if connect and not listen:
            return open_session("client", connect=connect, shared_memory=False), ", ".join(connect)
        try:
            session = open_session("server", listen=listen or None, connect=connect, shared_memory=False)
            return session, ", ".join(listen or [DEFAULT_ENDPOINT])
        except ConnectionFailed:
            if listen:
                raise
            return open_session("client", connect=[DEFAULT_ENDPOINT], shared_memory=False), DEFAULT_ENDPOINT
    except ConnectionFailed as error:
        raise ClientError(str(error)) from None
