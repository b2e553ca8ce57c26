# SPDX-License-Identifier: MIT
"""The command `sim-client web`."""

from __future__ import annotations

import logging
import socket
from collections.abc import Sequence
from importlib.util import find_spec

from clients.errors import BadInput, ClientError
from protocol.process.die_with_parent import die_with_parent
from protocol.process.extras import to_install


def web(server: str, connect: Sequence[str] | None, host: str, port: int, exit_with_parent: bool) -> None:
    """Serves the page until Ctrl-C. exit_with_parent: or until the parent process ends. Raises ClientError, BadInput."""
    if find_spec("viser") is None:
        raise ClientError(f"the page in a browser needs viser: {to_install('web')}")
    _check_free(host, port)
    if exit_with_parent:
        die_with_parent()
    from clients.web.page import Page

    logging.basicConfig(format="sim-client: %(message)s")
    page = Page(server, connect, host, port)
    try:
        print(f"the page is at http://{_shown(host)}:{page.port}", flush=True)
        page.run()
    finally:
        page.close()


def _check_free(host: str, port: int) -> None:
    """Raises BadInput if nobody can listen there: viser would take another port."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise BadInput(f"cannot listen on {host}:{port}: {why}; --port {port + 1} takes another port") from None


def _shown(host: str) -> str:
    return f"[{host}]" if ":" in host else host
