# SPDX-License-Identifier: MIT
"""Where pages and metrics are served: HOST:PORT, and whether the page of `sim-client web` can be."""

import ipaddress
import re
import socket
from importlib.util import find_spec

from protocol.network.hosts import beyond_loopback
from protocol.process.extras import to_install
from protocol.refused import Refused

HOST, PORT = "127.0.0.1", 8080
_ADDRESS = re.compile(r"(?:(?P<host>\[[0-9A-Fa-f:.%\w]+\]|[^:\s/\[\]]*):)?(?P<port>\d{1,5})")


def web_address(text: str, option: str = "--web", port: int = PORT) -> tuple[str, int]:
    """Returns host and port of HOST:PORT, :PORT, PORT, or of an IP address or localhost alone, with the port `port`.

    Raises Refused, which names the option.
    """
    if text == "localhost" or _is_ip(text.strip("[]")):
        return text.strip("[]"), port
    match = _ADDRESS.fullmatch(text)
    if match is None or not 1 <= int(match["port"]) <= 65535:
        allowed = f"HOST:PORT or PORT, PORT from 1 to 65535, for example {HOST}:{port}"
        raise Refused(f"{option} {text}: allowed is {allowed}", "malformed")
    return (match["host"] or HOST).strip("[]"), int(match["port"])


def _is_ip(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def shown(host: str, port: int) -> str:
    """Returns HOST:PORT, with brackets around an address that has colons."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def hindrance(host: str, port: int) -> str:
    """Returns why the page cannot be served there, and what helps; empty if it can be."""
    if find_spec("viser") is None:
        return f"the page in a browser needs viser, of the extra web: {to_install('web')}"
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        return f"the page cannot be served at {shown(host, port)}: {getattr(error, 'strerror', None) or error}"
    return ""


def exposed(host: str, port: int) -> str:
    """Returns a warning if other machines may reach the page; else nothing. It has no login."""
    if not beyond_loopback(f"tcp/{shown(host, port)}"):
        return ""
    return (
        f"{shown(host, port)}: anybody who reaches it may push, grab, pause and change what is simulated; a tunnel "
        f"(ssh -L {port}:127.0.0.1:{port} HOST) shows a page of loopback elsewhere"
    )
