# SPDX-License-Identifier: MIT
"""Endpoints as users give them: tcp/127.0.0.1:7447, tls/host:7447, unixsock-stream//run/sim.sock."""

import os
import re

from protocol.channels import DEFAULT_ENDPOINT

NETWORK = ("tcp", "udp", "tls", "quic", "ws")
CERTIFIED = ("tls", "quic")  # protocols that ask for certificates
# zenoh 1.10.2 finishes one handshake of QUIC after another: a datagram that begins one, from whatever address it says,
# keeps all new sessions out for 30 s.
ONLY_CONNECT = "quic"
LOCAL = ("unixsock-stream",)
CONNECT = "WARPFACTOR_CONNECT"  # endpoints of the server, where none is given on the command line
_ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.%\w]+\]|[^:\s/\[\]]+):(\d{1,5})")


class BadEndpoint(ValueError):
    """An endpoint that cannot be used; the text says what is allowed."""


def default_endpoint(certified: bool = False) -> str:
    """Returns where a server listens by default. certified: with certificates."""
    return DEFAULT_ENDPOINT.replace("tcp/", "tls/") if certified else DEFAULT_ENDPOINT


def check_endpoint(endpoint: str, *, listen: bool = False, certified: bool = False) -> str:
    """Returns the endpoint itself; raises BadEndpoint. Port 0 (any free one) is only for listening.

    certified: certificates are to be used, so that protocols without them are refused
    """
    protocol, _, rest = endpoint.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if listen and protocol == ONLY_CONNECT:
        raise BadEndpoint(
            f"endpoint {endpoint!r} cannot be listened on: one datagram to it would keep new sessions out for half a "
            f"minute; allowed: tls/{rest}"
        )
    if certified and protocol not in CERTIFIED and protocol in (*NETWORK, *LOCAL):
        raise BadEndpoint(f"endpoint {endpoint!r} cannot be used with --tls; allowed: tls/HOST:PORT")
    if protocol in LOCAL and address:
        return endpoint
    match = _ADDRESS.fullmatch(address)
    low = 0 if listen else 1
    if protocol not in NETWORK or match is None or not low <= int(match.group(2)) <= 65535:
        raise BadEndpoint(
            f"endpoint {endpoint!r} cannot be used; allowed: PROTOCOL/HOST:PORT with PROTOCOL one of "
            f"{', '.join(NETWORK)} and PORT {low} to 65535, or unixsock-stream/PATH; for example {DEFAULT_ENDPOINT}"
        )
    return endpoint


def usual_endpoints(certified: bool = False) -> list[str]:
    """Returns where workers and clients connect by default. Raises BadEndpoint. certified: with certificates."""
    return given_endpoints() or [default_endpoint(certified)]


def given_endpoints() -> list[str]:
    """Returns the endpoints of WARPFACTOR_CONNECT. Raises BadEndpoint."""
    found = re.split(r"[,\s]+", os.environ.get(CONNECT, "").strip(", \t\n"))
    try:
        return [check_endpoint(endpoint) for endpoint in found if endpoint]
    except BadEndpoint as error:
        raise BadEndpoint(f"{CONNECT}: {error}") from None


def on_this_machine(endpoint: str) -> str:
    """Returns the endpoint by which a process of this machine reaches who listens on `endpoint`."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def host_of(endpoint: str) -> str:
    """Returns the host name or address of an endpoint; empty if it has none (a path)."""
    protocol, _, rest = endpoint.partition("/")
    match = _ADDRESS.fullmatch(re.split(r"[?#]", rest, maxsplit=1)[0])
    return match.group(1).strip("[]") if match and protocol not in LOCAL else ""


def port_of(endpoint: str) -> int:
    """Returns the port of an endpoint; 0 if it has none (a path)."""
    match = _ADDRESS.fullmatch(re.split(r"[?#]", endpoint.partition("/")[2], maxsplit=1)[0])
    return int(match.group(2)) if match else 0
