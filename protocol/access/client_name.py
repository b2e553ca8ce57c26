# SPDX-License-Identifier: MIT
"""Names of clients that nobody else can use: a name is a digest of a secret, which is sent with each command.

Names are public, in the status and in liveliness tokens; the secret is sent to the server alone, which checks it
without state. With TLS a name begins with that of the client's certificate, and access rules let nobody else use it.
"""

import hashlib
import re
import secrets

from protocol.access.roles import own_name
from protocol.refused import Refused

SECRET_BYTES = 16
_DIGITS = 24  # hexadecimal: 96 bits of SHA-256
_DIGEST = re.compile(rf"(?:[^.]*\.)?(client-[0-9a-f]{{{_DIGITS}}})")


def new_client(identity: str = "") -> tuple[str, bytes]:
    """Returns a new name and its secret. identity: common name of the certificate; empty without one."""
    secret = secrets.token_bytes(SECRET_BYTES)
    return own_name(identity, _name(secret)), secret


def check_client(name: str, secret: bytes) -> None:
    """Raises Refused if the name is a digest, but not of this secret. Names of older clients are not checked."""
    match = _DIGEST.fullmatch(name)
    if match is not None and (len(secret) != SECRET_BYTES or match[1] != _name(secret)):
        text = f"Command.secret does not belong to client {name!r}; allowed: the one that made this name"
        raise Refused(text, "secret")


def _name(secret: bytes) -> str:
    return f"client-{hashlib.sha256(secret).hexdigest()[:_DIGITS]}"
