# SPDX-License-Identifier: MIT
"""What workers sent and nobody took yet, in bounded rings that block no sender."""

import contextlib
from collections import deque
from collections.abc import Collection, Iterator

import zenoh
from zenoh.handlers import RingChannel

from protocol.channels import key, name_in
from protocol.refused import Refused

# Messages that may wait; beyond that the oldest is lost. In this order they are taken: factors before tokens, since a
# worker may answer and then leave.
RINGS = {"worker": 1024, "pattern": 64, "factor": 64}
TOKENS = 4096


class Inbox:
    """Iterating gives (channel, sample) of all that arrived since the last time."""

    def __init__(self, session: zenoh.Session, server: str):
        self._session, self._tokens = session, key("alive_worker", server)
        self._found: deque[zenoh.Sample] = deque(maxlen=TOKENS)  # tokens that were asked for
        self._rings = {
            channel: session.declare_subscriber(key(channel, server), RingChannel(depth))
            for channel, depth in RINGS.items()
        }
        self._rings["alive_worker"] = session.liveliness().declare_subscriber(
            self._tokens, RingChannel(TOKENS), history=True
        )

    def ask_for_tokens(self, workers: Collection[str]) -> None:
        """Those of these workers that have one arrive as if their tokens came just now."""

        def found(reply: zenoh.Reply) -> None:
            with contextlib.suppress(Refused):
                if reply.ok is not None and name_in("alive_worker", reply.ok.key_expr, "worker") in workers:
                    self._found.append(reply.ok)

        with contextlib.suppress(zenoh.ZError):  # the session was closed
            self._session.liveliness().get(self._tokens, zenoh.handlers.Callback(found), timeout=1.0)

    def __iter__(self) -> Iterator[tuple[str, zenoh.Sample]]:
        for channel in self._rings:
            yield from self._of(channel)
        while self._found:
            yield "alive_worker", self._found.popleft()

    def _of(self, channel: str) -> Iterator[tuple[str, zenoh.Sample]]:
        while (sample := self._rings[channel].try_recv()) is not None:
            if channel == "factor":  # its pattern, sent just before it, may have come since patterns were looked at
                yield from self._of("pattern")
            yield channel, sample
