# SPDX-License-Identifier: MIT
"""Publishing to whoever listens, at next to no cost when nobody does."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import zenoh

from protocol.channels import key
from protocol.counters import Counters
from sim_server.network.send_queue import SendQueue


class Publishers:
    """Publishers of the server, declared as they are first used. A slow listener loses frames, never holds us up."""

    def __init__(self, session: zenoh.Session, server: str, outbox: SendQueue, counters: Counters):
        self._session = session
        self._server = server
        self._outbox = outbox
        self._counters = counters
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._sequence: Counter[str] = Counter()

    def wanted(self, channel: str, **names: str) -> bool:
        """Somebody listens."""
        return _matched(self._publisher(key(channel, self._server, **names)))

    def put(self, channel: str, message: Any, stamp: Callable[[Any, int], None], **names: str) -> None:
        """Send a message if somebody listens. A state replaces an older one that still waits to be sent."""
        name = key(channel, self._server, **names)
        publisher = self._publisher(name)
        if not _matched(publisher):
            return
        self._sequence[name] += 1
        stamp(message, self._sequence[name])
        data = message.SerializeToString()
        latest = name if channel in ("state", "status") else None
        if not self._outbox.post(lambda: publisher.put(data), latest):
            self._counters.add("frames_dropped")

    def _publisher(self, name: str) -> zenoh.Publisher:
        if name not in self._publishers:
            self._publishers[name] = self._session.declare_publisher(
                name, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW
            )
        return self._publishers[name]


def _matched(publisher: zenoh.Publisher) -> bool:
    status: Any = publisher.matching_status  # a bool in zenoh's stubs, an object with a bool when it runs
    return bool(getattr(status, "matching", status))
