# SPDX-License-Identifier: MIT
"""A server without a simulation: answers queries, publishes, takes commands. A replay is published by it."""

from __future__ import annotations

import logging
import secrets
from collections import Counter, deque
from collections.abc import Sequence
from typing import Any, Self

import zenoh

from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, PROTOCOL, check_name, commands, everything, key
from protocol.network.endpoints import BadEndpoint, default_endpoint
from protocol.network.exposure import check_exposure
from protocol.network.session import ConnectionFailed, Session, open_session
from protocol.refused import Refused
from protocol.validate import check_header, parse

log = logging.getLogger(__name__)

MAX_COMMANDS = 64  # that wait; beyond that they are refused
TOKEN_TIMEOUT = 1.0  # s for the query of liveliness tokens


class ReplayServer:
    """Appears on the network as server `name`; a context manager.

    name: raises ClientError if it is taken; None: `otherwise`, with a suffix if that is taken. connect: endpoints of a
    router to join; listen: endpoints to listen on. Without both it listens on the default port, or joins the server
    that does. insecure: other machines may reach it, though nothing keeps anybody out
    """

    def __init__(
        self, name: str | None, otherwise: str, connect: Sequence[str] | None, listen: Sequence[str] | None,
        insecure: bool = False,
    ) -> None:  # fmt: skip
        self.incarnation = secrets.randbits(63) | 1
        self._sequence: Counter[str] = Counter()
        self._answers: dict[str, bytes] = {}
        self._commands: deque[zenoh.Query] = deque()
        try:
            wanted = check_name(otherwise if name is None else name, "server name")
            if not insecure:
                check_exposure(listen or [], [])
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
        """Sets the answer to queries of a key."""
        self._stamp(channel, message)
        self._answers[key(channel, self.name, **names)] = message.SerializeToString()

    def put(self, channel: str, message: Any, wait: bool = False, **names: str) -> None:
        """Publishes a message; wait: blocks for the slowest subscriber instead of dropping messages."""
        self._stamp(channel, message)
        control = zenoh.CongestionControl.BLOCK if wait else zenoh.CongestionControl.DROP
        self._zenoh.put(key(channel, self.name, **names), message.SerializeToString(), congestion_control=control)

    def commands(self) -> list[tuple[str, zenoh.Query]]:
        """Returns (verb, query) of the commands since the last call; each query must be answered."""
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
        """Answers one command."""
        self._stamp("reply", reply)
        try:
            query.reply(query.key_expr, reply.SerializeToString())
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
        tokens = self._session.zenoh.liveliness().get(key("alive_server", name), timeout=TOKEN_TIMEOUT)
        return any(token.ok is not None for token in tokens)

    def _serve(self, query: zenoh.Query) -> None:
        if str(query.key_expr).startswith(commands(self.name)):
            if len(self._commands) < MAX_COMMANDS:
                self._commands.append(query)
            else:
                self.answer(query, pb.Reply(error=f"the replay is busy: {MAX_COMMANDS} commands wait already"))
            return
        with query:
            for name, data in list(self._answers.items()):
                if query.key_expr.intersects(zenoh.KeyExpr(name)):
                    query.reply(name, data)


def _joined(connect: Sequence[str] | None, listen: Sequence[str] | None) -> tuple[Session, str]:
    """Returns a session and its endpoints: it listens itself, or joins the server that does."""
    try:
        if connect and not listen:
            return open_session("client", connect=connect, shared_memory=False), ", ".join(connect)
        try:
            session = open_session("server", listen=listen or None, connect=connect, shared_memory=False)
            return session, ", ".join(listen or [default_endpoint()])
        except ConnectionFailed:
            if listen:
                raise
            return open_session("client", connect=[default_endpoint()], shared_memory=False), default_endpoint()
    except ConnectionFailed as error:
        raise ClientError(str(error)) from None
