# SPDX-License-Identifier: MIT
"""Messages of workers that were not read yet, in bounded rings that block no sender."""

import contextlib
from collections import deque
from collections.abc import Collection, Iterator

import zenoh
from zenoh.handlers import RingChannel

from protocol.channels import MOST_JOBS, key, name_in
from protocol.refused import Refused

# Messages that may wait in each channel; beyond that the oldest is lost. Channels are read in this order, and tokens
# after them: a worker may send a factor and then leave.
RINGS = {"worker": 1024, "pattern": MOST_JOBS, "factor": MOST_JOBS}
TOKENS = 4096


class Inbox:
    """Iterating yields (channel, sample) of all messages that arrived since the last iteration."""

    def __init__(self, session: zenoh.Session, server: str):
        self._session, self._tokens = session, key("alive_worker", server)
        self._queried: deque[zenoh.Sample] = deque(maxlen=TOKENS)  # tokens found by query_tokens
        self._rings = {
            channel: session.declare_subscriber(key(channel, server), RingChannel(depth))
            for channel, depth in RINGS.items()
        }
        self._rings["alive_worker"] = session.liveliness().declare_subscriber(
            self._tokens, RingChannel(TOKENS), history=True
        )

    def query_tokens(self, workers: Collection[str]) -> None:
        """Queries the liveliness tokens of workers; those found arrive as if they had been declared just now."""

        def found(reply: zenoh.Reply) -> None:
            with contextlib.suppress(Refused):
                if reply.ok is not None and name_in("alive_worker", reply.ok.key_expr, "worker") in workers:
                    self._queried.append(reply.ok)

        with contextlib.suppress(zenoh.ZError):  # the session was closed
            self._session.liveliness().get(self._tokens, zenoh.handlers.Callback(found), timeout=1.0)

    def __iter__(self) -> Iterator[tuple[str, zenoh.Sample]]:
        for channel in self._rings:
            yield from self._read(channel)
        while self._queried:
            yield "alive_worker", self._queried.popleft()

    def _read(self, channel: str) -> Iterator[tuple[str, zenoh.Sample]]:
        while (sample := self._rings[channel].try_recv()) is not None:
            if channel == "factor":  # its pattern is sent just before it and may have arrived after patterns were read
                yield from self._read("pattern")
            yield channel, sample
