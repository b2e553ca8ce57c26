# SPDX-License-Identifier: MIT
"""Which commands a client may send, by the certificate that its name begins with."""

from collections.abc import Mapping

from protocol.access.roles import ROLES, VERBS, identity_in, may
from protocol.messages_pb2 import Command, Reply
from protocol.refused import Refused


class Rights:
    """roles: by common name of the certificate; None: without TLS, where every client may do everything.

    Access rules of zenoh have refused what is refused here already; a router may have other ones.
    """

    def __init__(self, roles: Mapping[str, str] | None):
        self._roles = roles

    def of(self, client: str) -> Reply:
        """Returns the answer to the verb `rights`."""
        if self._roles is None:
            return Reply(verbs=VERBS)
        role = self._roles.get(identity_in(client), "")
        return Reply(role=role, verbs=ROLES[role].verbs if role else ())

    def account(self, client: str) -> str:
        """Returns whose limit of commands a second counts: of a certificate all clients have one together."""
        return client if self._roles is None else identity_in(client)

    def check(self, command: Command) -> None:
        """Raises Refused if the client may not send the command."""
        if self._roles is None:
            return
        identity = identity_in(command.client)
        role = self._roles.get(identity)
        if role is None:
            raise Refused(f"no certificate {identity!r} has a role here", "role")
        if command.verb in VERBS and command.verb not in ROLES[role].verbs:
            text = f"{command.verb} is not for {identity!r}, a {role}; allowed: {may(command.verb)}"
            raise Refused(text, "role")
