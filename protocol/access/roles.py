# SPDX-License-Identifier: MIT
"""What holders of certificates may do: the role of each, the verbs of each role, and the names that are theirs."""

import re
from collections.abc import Mapping
from typing import NamedTuple

from protocol.refused import Refused


class Role(NamedTuple):
    """verbs: commands that it may send. looks: it may read what is simulated. sentence: for people."""

    sentence: str
    verbs: tuple[str, ...] = ()
    looks: bool = True


ALWAYS = ("rights", "status", "parameters")  # verbs that change nothing
TOUCHING = ("push", "grab", "move", "release", "move_obstacle", "cut")
RULING = ("set", "pause", "resume", "step", "reset", "save", "stop", "add_worker", "kill_worker")
VERBS = (*ALWAYS, *TOUCHING, *RULING)

ROLES: dict[str, Role] = {
    "viewer": Role("looks", ALWAYS),
    "participant": Role("looks, pushes, grabs, cuts, and moves obstacles", (*ALWAYS, *TOUCHING)),
    "operator": Role("does all that clients can", VERBS),
    "worker": Role("makes factors", looks=False),
    "router": Role("passes on what its own rules allow", looks=False),
}

# No dot in it: what follows one in a name of a client or worker is free.
_IDENTITY = re.compile(r"[A-Za-z0-9_-]{1,32}")


def check_identity(name: str, what: str) -> str:
    """Returns the name itself if it can be that of a certificate; raises Refused otherwise."""
    if not _IDENTITY.fullmatch(name):
        raise Refused(f"{what} is {name[:80]!r}; allowed: 1 to 32 characters of A-Z a-z 0-9 _ -", "malformed")
    return name


def check_role(role: str, what: str) -> str:
    """Returns the role itself if there is one of this name; raises Refused otherwise."""
    if role not in ROLES:
        raise Refused(f"{what} is {str(role)[:80]!r}; allowed: {', '.join(ROLES)}", "malformed")
    return role


def check_roles(roles: Mapping[str, object], what: str) -> dict[str, str]:
    """Returns roles by name of certificate, checked. Raises Refused."""
    return {check_identity(name, what): check_role(str(role), f"{what}: {name}") for name, role in roles.items()}


def own_name(identity: str, name: str) -> str:
    """Returns a name that access rules let the holder of this certificate alone use; without one `name` itself."""
    return f"{identity}.{name}" if identity else name


def identity_in(name: str) -> str:
    """Returns the certificate that a name of a client or worker belongs to; empty if it is of none."""
    identity, dot, _ = name.partition(".")
    return identity if dot else ""


def may(verb: str) -> str:
    """Returns the roles that have a verb, for people."""
    return " or ".join(name for name, role in ROLES.items() if verb in role.verbs)
