# SPDX-License-Identifier: MIT
"""What workers sent and nobody took yet, in bounded rings that block no sender."""

from collections.abc import Iterator

import zenoh
from zenoh.handlers import RingChannel

from protocol.channels import key

# Messages that may wait; beyond that the oldest is lost. In this order they are taken: factors before tokens, since a
# worker may answer and then leave.
RINGS = {"worker": 1024, "pattern": 64, "factor": 64}
TOKENS = 4096


class Arrivals:
    """Iterating gives (channel, sample) of all that arrived since the last time."""

    def __init__(self, session: zenoh.Session, server: str):
        self._rings = {
            channel: session.declare_subscriber(key(channel, server), RingChannel(depth))
            for channel, depth in RINGS.items()
        }
        self._rings["alive_worker"] = session.liveliness().declare_subscriber(
            key("alive_worker", server), RingChannel(TOKENS), history=True
        )

    def __iter__(self) -> Iterator[tuple[str, zenoh.Sample]]:
        for channel in self._rings:
            yield from self._of(channel)

    def _of(self, channel: str) -> Iterator[tuple[str, zenoh.Sample]]:
        while (sample := self._rings[channel].try_recv()) is not None:
            if channel == "factor":  # its pattern, sent just before it, may have come since patterns were looked at
                yield from self._of("pattern")
            yield channel, sample
