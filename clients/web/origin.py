# SPDX-License-Identifier: MIT
"""Keeps other web sites out, which a browser on this machine lets connect to a page of loopback.

viser takes every connection. Its server is made here with a check before each request: a connection has to come from a
page of the same address (header Origin, RFC 6454), and by a name of loopback where the page is (against DNS rebinding).
It also asks tabs for a sign of life more often than by default, so that one that is gone lets go soon.
"""

from __future__ import annotations

import contextlib
import http
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server as server

PING_PERIOD, PING_TIMEOUT = 5.0, 10.0  # s: a tab whose network is gone lets go after the sum of both at the latest
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def foreign(origin: str | None, host: str | None, loopback: bool) -> bool:
    """Returns True for a request by another site. origin, host: its headers; loopback: the page is for this machine."""
    name = urlsplit(f"//{host or ''}").hostname
    if loopback and host and name not in LOOPBACK:
        return True
    return origin is not None and urlsplit(origin).netloc != host


@contextlib.contextmanager
def own_pages_only(loopback: bool) -> Iterator[None]:
    """A server that is started in this context refuses requests by other sites, and notices soon when a tab is gone."""
    serve = server.serve

    def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if foreign(request.headers.get("Origin"), request.headers.get("Host"), loopback):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "this page is not for other sites\n")
            return process_request(connection, request)

        options |= {"ping_interval": PING_PERIOD, "ping_timeout": PING_TIMEOUT}
        return serve(*arguments, process_request=check, **options)

    server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
