# SPDX-License-Identifier: MIT
"""Whether a server is open to anybody: zenoh accepts every connection that its configuration does not restrict."""

import json
import os
from collections.abc import Sequence
from typing import Any

import zenoh

from protocol.network.endpoints import CERTIFIED, BadEndpoint
from protocol.network.hosts import beyond_loopback
from protocol.network.session import EXTRA_CONFIG

CERTS = "`sim-server certs DIR --host NAME` makes certificates, and --tls DIR asks for them"


def unrestricted(endpoints: Sequence[str], certified: bool = False) -> list[str]:
    """Returns the endpoints that other machines reach without certificates of both sides and access rules.

    certified: the certificates and rules of --tls are used. Else those of a configuration of one's own count.
    """
    reachable = [endpoint for endpoint in endpoints if beyond_loopback(endpoint)]
    if reachable and (certified or _restricts(os.environ.get(EXTRA_CONFIG))):
        return [endpoint for endpoint in reachable if endpoint.partition("/")[0] not in CERTIFIED]
    return reachable


def check_exposure(listen: Sequence[str], connect: Sequence[str], certified: bool = False) -> None:
    """Raises BadEndpoint if others than holders of certificates may reach who listens and connects there.

    A router that a server connects to passes on what anybody sends to it.
    """
    for option, endpoints in (("--listen", listen), ("--connect", connect)):
        for endpoint in unrestricted(endpoints, certified):
            who = "anybody who reaches it" if option == "--listen" else "anybody who reaches that router or server"
            raise BadEndpoint(
                f"{option} {endpoint}: {who} may push, grab, pause, stop and send factors. Two ways on: {CERTS} "
                f"(then {option} {_certified(endpoint)}); --insecure lets everybody in"
            )


def _certified(endpoint: str) -> str:
    return f"tls/{endpoint.partition('/')[2]}"


def _restricts(path: str | None) -> bool:
    if not path:
        return False
    config = zenoh.Config.from_file(path)
    return bool(_value(config, "access_control/enabled") and _value(config, "transport/link/tls/enable_mtls"))


def _value(config: zenoh.Config, name: str) -> Any:
    try:
        return json.loads(config.get_json(name))
    except (zenoh.ZError, ValueError):
        return None
