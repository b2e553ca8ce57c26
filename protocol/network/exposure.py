# SPDX-License-Identifier: MIT
"""Whether a server is open to anybody: zenoh accepts every connection that its configuration does not restrict."""

import json
import os
from collections.abc import Sequence
from typing import Any

import zenoh

from protocol.network.hosts import beyond_loopback
from protocol.network.session import EXTRA_CONFIG

CERTIFIED = ("tls", "quic")  # protocols that may ask for a certificate of the client


def unrestricted(endpoints: Sequence[str]) -> list[str]:
    """Returns the endpoints that other machines reach without certificate, password or access rules."""
    reachable = [endpoint for endpoint in endpoints if beyond_loopback(endpoint)]
    path = os.environ.get(EXTRA_CONFIG)
    if not reachable or not path:
        return reachable
    config = zenoh.Config.from_file(path)
    if _value(config, "access_control/enabled") or _value(config, "transport/auth/usrpwd/dictionary_file"):
        return []
    certified = _value(config, "transport/link/tls/enable_mtls")
    return [e for e in reachable if not (certified and e.partition("/")[0] in CERTIFIED)]


def _value(config: zenoh.Config, name: str) -> Any:
    try:
        return json.loads(config.get_json(name))
    except (zenoh.ZError, ValueError):
        return None
