# SPDX-License-Identifier: MIT
"""Hosts of endpoints: whether their names resolve, and whether other machines reach them."""

import ipaddress
import socket
from collections.abc import Sequence

from protocol.network.endpoints import host_of


def unknown_hosts(endpoints: Sequence[str]) -> list[str]:
    """Returns the host names that do not resolve."""
    return [host for host in map(host_of, endpoints) if host and not _addresses(host)]


def beyond_loopback(endpoint: str) -> bool:
    """True if other machines may reach a process that listens there."""
    host = host_of(endpoint)
    return bool(host) and not all(address.is_loopback for address in _addresses(host))


def _addresses(host: str) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return []
    return [ipaddress.ip_address(str(address[0]).partition("%")[0]) for *_, address in found]
