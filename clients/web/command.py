# SPDX-License-Identifier: MIT
"""The command `sim-client web`."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from clients.errors import BadInput, ClientError
from protocol.channels import check_name
from protocol.network.endpoints import BadEndpoint, check_endpoint, usual_endpoints
from protocol.network.web_address import exposed, hindrance, shown
from protocol.process.die_with_parent import die_with_parent
from protocol.refused import Refused

log = logging.getLogger(__name__)


def web(
    server: str, connect: Sequence[str] | None, host: str, port: int, exit_with_parent: bool, parent: int | None = None
) -> None:
    """Serves the page until Ctrl-C, or with exit_with_parent until the parent process ends.

    parent: its process id, by which one that is dead already is noticed. The server need not run yet.

    Raises ClientError, BadInput.
    """
    logging.basicConfig(format="sim-client: %(message)s")
    try:
        check_name(server, "server name")
        for endpoint in connect or usual_endpoints():
            check_endpoint(endpoint)
    except (Refused, BadEndpoint) as error:
        raise BadInput(str(error)) from None
    if why := hindrance(host, port):
        raise ClientError(why)
    if warning := exposed(host, port):
        log.warning("%s", warning)
    if exit_with_parent:
        die_with_parent(parent)
    from clients.web.page import Page

    page = Page(server, connect, host, port)
    try:
        print(f"sim-client: the page is at http://{shown(host, page.port)}", flush=True)
        page.run()
    finally:
        page.close()
