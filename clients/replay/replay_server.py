# SPDX-License-Identifier: MIT
"""A server without a simulation: answers queries, publishes, takes commands. A replay is published by it."""

from __future__ import annotations

import logging
import secrets
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Any, Self

import zenoh

from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb
from protocol.access.rights import Rights
from protocol.channels import CHANNELS, PROTOCOL, check_name, commands, everything, key
from protocol.network.access_rules import access_rules
from protocol.network.endpoints import BadEndpoint, default_endpoint
from protocol.network.exposure import check_exposure
from protocol.network.identity import SERVER, Identity, identity_of, roles_of
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
    that does. insecure: other machines may reach it, though nothing keeps anybody out. tls: folder of the certificate
    of a server; roles of others are read beside it
    """

    def __init__(
        self, name: str | None, otherwise: str, connect: Sequence[str] | None, listen: Sequence[str] | None,
        insecure: bool = False, tls: str | None = None,
    ) -> None:  # fmt: skip
        self.incarnation = secrets.randbits(63) | 1
        self._sequence: Counter[str] = Counter()
        self._answers: dict[str, bytes] = {}
        self._commands: deque[zenoh.Query] = deque()
        try:
            wanted = check_name(otherwise if name is None else name, "server name")
            identity = None if tls is None else _certificate(tls)
            if not insecure:
                check_exposure(listen or [], [], identity is not None)
            names = _names(wanted, name is not None)
            roles = None if identity is None else roles_of(identity)
            self._rights = Rights(roles)
            rules = None if roles is None else access_rules(names, roles)
            self._session, self.where = _joined(connect, listen, identity, rules)
        except (Refused, BadEndpoint) as error:
            raise BadInput(str(error)) from None
        try:
            self.name = self._free(names)
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
                if str(query.key_expr) != f"{commands(self.name)}{command.verb}/{command.client}":
                    raise Refused("a Command came under the key of another; allowed: its own", "key")
                self._rights.check(command)
                if command.verb == "rights":
                    self.answer(query, self._rights.of(command.client))
                else:
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

    def _free(self, names: Sequence[str]) -> str:
        for name in names:
            if not self._taken(name):
                return name
        several = f"live servers {names[0]!r}, {names[-1]!r} and more are"
        which = several if len(names) > 1 else f"a live server {names[0]!r} is"
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


def _names(wanted: str, asked: bool) -> list[str]:
    """Returns the names that it may take."""
    names = [wanted, f"{wanted}-replay", *(f"{wanted}-replay-{k}" for k in range(2, 10))]
    return names[:1] if asked else [name for name in names if len(name) <= 64]


def _certificate(folder: str) -> Identity:
    """Returns the certificate of a server in a folder. Raises Refused."""
    identity = identity_of(folder, (SERVER,))
    if identity.role != SERVER:
        text = f"--tls {folder}: this certificate is that of a {identity.role}; a replay shows that of a server"
        raise Refused(text, "malformed")
    return identity


def _joined(
    connect: Sequence[str] | None, listen: Sequence[str] | None, tls: Identity | None,
    access: Mapping[str, Any] | None,
) -> tuple[Session, str]:  # fmt: skip
    """Returns a session and its endpoints: it listens itself, or joins the server that does."""
    usual = default_endpoint(tls is not None)

    def joined(endpoints: Sequence[str]) -> tuple[Session, str]:
        return open_session("client", connect=endpoints, shared_memory=False, tls=tls), ", ".join(endpoints)

    try:
        if connect and not listen:
            return joined(connect)
        try:
            session = open_session(
                "server", listen=listen or None, connect=connect, shared_memory=False, tls=tls, access=access
            )
            return session, ", ".join(listen or [usual])
        except ConnectionFailed:
            if listen:
                raise
            return joined([usual])
    except ConnectionFailed as error:
        raise ClientError(str(error)) from None
