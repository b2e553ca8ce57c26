# SPDX-License-Identifier: MIT
"""Names and endpoints of the servers to serve: --server NAME[@ENDPOINT], repeatable; * is every server."""

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.channels import check_name
from protocol.network.endpoints import check_endpoint, usual_endpoints

EVERY = "*"


@dataclass(frozen=True)
class ServerAddress:
    """Endpoints of one session, of which the first that answers is taken, and the names of its servers or EVERY."""

    endpoints: tuple[str, ...]
    servers: tuple[str, ...]

    def __str__(self) -> str:
        return ", ".join(self.endpoints)


def server_addresses(servers: Sequence[str], connect: Sequence[str], certified: bool = False) -> list[ServerAddress]:
    """Groups servers by endpoint; those without one have the endpoints of --connect. certified: with certificates.

    Raises BadEndpoint or Refused, both ValueErrors, that name the option.
    """
    for endpoint in connect:
        check_endpoint(endpoint, certified=certified)
    usual = tuple(connect) or tuple(usual_endpoints(certified))
    names: dict[tuple[str, ...], list[str]] = {}
    for server in servers:
        name, at, endpoint = server.partition("@")
        if name != EVERY:
            check_name(name, "--server")
        there = names.setdefault((check_endpoint(endpoint, certified=certified),) if at else usual, [])
        if name in there:
            raise ValueError(f"--server {server} is given twice")
        there.append(name)
    return [ServerAddress(where, (EVERY,) if EVERY in there else tuple(there)) for where, there in names.items()]
