# SPDX-License-Identifier: MIT
"""Publishes messages to subscribers; without any, a message costs next to nothing."""

from collections import Counter
from collections.abc import Callable

import zenoh

from protocol.channels import key
from protocol.counters import Counters
from protocol.messages_pb2 import Need, ObstaclePose, State, Status, Steps
from sim_server.network.send_queue import SendQueue

URGENT = ("reactions",)  # channels whose messages are sent at once, before others
Published = Need | ObstaclePose | State | Status | Steps


class Publishers:
    """The zenoh publishers of a server, declared at their first use. A slow subscriber loses messages.

    urgent: the queue of URGENT channels, whose messages wait for no other
    stamp: fills in the header of a message, given its sequence number
    """

    def __init__(
        self, session: zenoh.Session, server: str, queue: SendQueue, urgent: SendQueue, counters: Counters,
        stamp: Callable[[Published, int], None],
    ):  # fmt: skip
        self._session = session
        self._server = server
        self._queue, self._urgent = queue, urgent
        self._counters = counters
        self._stamp = stamp
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._sequence: Counter[str] = Counter()

    def has_subscribers(self, channel: str, **names: str) -> bool:
        """True if somebody subscribed to the channel. names: parts of its key, as of `key`."""
        return _matched(self._publisher(key(channel, self._server, **names), channel in URGENT))

    def put(self, channel: str, message: Published, **names: str) -> None:
        """Sends a message if there are subscribers. A state, pose or status replaces one that waits to be sent."""
        name = key(channel, self._server, **names)
        publisher = self._publisher(name, channel in URGENT)
        if not _matched(publisher):
            return
        self._sequence[name] += 1
        self._stamp(message, self._sequence[name])
        data = message.SerializeToString()
        latest = name if channel in ("state", "pose", "status") else None
        queue = self._urgent if channel in URGENT else self._queue
        if not queue.post(lambda: publisher.put(data), latest):
            self._counters.add("frames_dropped")

    def _publisher(self, name: str, urgent: bool) -> zenoh.Publisher:
        if name not in self._publishers:
            priority = zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA_LOW
            self._publishers[name] = self._session.declare_publisher(
                name, congestion_control=zenoh.CongestionControl.DROP, priority=priority
            )
        return self._publishers[name]


def _matched(publisher: zenoh.Publisher) -> bool:
    status: object = publisher.matching_status  # a bool in zenoh's stubs, an object with a bool when it runs
    return bool(getattr(status, "matching", status))
