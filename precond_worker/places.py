# SPDX-License-Identifier: MIT
"""Which servers a worker serves, and where they are: --server NAME[@ENDPOINT], may be repeated; * is every server."""

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.channels import check_name
from protocol.endpoints import check_endpoint, usual_endpoints

EVERY = "*"


@dataclass(frozen=True)
class Place:
    """One session: to the first of the endpoints that answers. servers: their names there, or EVERY alone."""

    endpoints: tuple[str, ...]
    servers: tuple[str, ...]

    def __str__(self) -> str:
        return ", ".join(self.endpoints)


def places(servers: Sequence[str], connect: Sequence[str]) -> list[Place]:
    """Servers by where they are; those named without an endpoint are where connect says.

    Raises BadEndpoint or Refused, both ValueErrors, that name the option.
    """
    for endpoint in connect:
        check_endpoint(endpoint)
    usual = tuple(connect) or tuple(usual_endpoints())
    names: dict[tuple[str, ...], list[str]] = {}
    for server in servers:
        name, at, endpoint = server.partition("@")
        if name != EVERY:
            check_name(name, "--server")
        there = names.setdefault((check_endpoint(endpoint),) if at else usual, [])
        if name in there:
            raise ValueError(f"--server {server} is given twice")
        there.append(name)
    return [Place(where, (EVERY,) if EVERY in there else tuple(there)) for where, there in names.items()]
