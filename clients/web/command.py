# SPDX-License-Identifier: MIT
"""The command `sim-client web`."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from clients.errors import ClientError
from protocol.network.web_address import exposed, hindrance, shown
from protocol.process.die_with_parent import die_with_parent

log = logging.getLogger(__name__)


def web(server: str, connect: Sequence[str] | None, host: str, port: int, exit_with_parent: bool) -> None:
    """Serves the page until Ctrl-C, or with exit_with_parent until the parent process ends. Raises ClientError."""
    logging.basicConfig(format="sim-client: %(message)s")
    if why := hindrance(host, port):
        raise ClientError(why)
    if warning := exposed(host, port):
        log.warning("%s", warning)
    if exit_with_parent:
        die_with_parent()
    from clients.web.page import Page

    page = Page(server, connect, host, port)
    try:
        print(f"sim-client: the page is at http://{shown(host, page.port)}", flush=True)
        page.run()
    finally:
        page.close()
