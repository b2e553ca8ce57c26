# SPDX-License-Identifier: MIT
"""Subscriptions to the states, steps and poses of a server: a slow reader gets the newest and never a backlog."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import zenoh

from clients.log.frames import Frame, frame_of
from clients.log.obstacles import ObstacleFrame, obstacle_frame_of
from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, key
from protocol.refused import Refused
from protocol.validate import check_header, check_numbers, parse

BATCHES = 64  # batches of steps that are kept, about 3 s
REACTIONS = 1024  # batches of reactions, about 1 s

log = logging.getLogger(__name__)

Incarnation = Callable[[], int | None]
"""Returns that of the server whose messages count, since anybody may send some in its name; None: all count."""


def unknown() -> int | None:
    """Returns None: whoever sends under the keys of the server counts."""
    return None


class _Refusals:
    """Tells of the first message that was left out; whoever sends many fills no terminal."""

    def __init__(self) -> None:
        self._count = 0

    def note(self, what: str, refusal: Refused) -> None:
        self._count += 1
        if self._count == 1:
            log.warning("%s were left out: %s (further ones without a word)", what, refusal)


class States:
    """The newest frame of each object, in a ring of one sample per object."""

    def __init__(
        self, session: zenoh.Session, server: str, objects: list[str], incarnation: Incarnation = unknown
    ) -> None:  # fmt: skip
        self._incarnation, self._refusals = incarnation, _Refusals()
        self._rings = {
            name: session.declare_subscriber(key("state", server, object=name), zenoh.handlers.RingChannel(1))
            for name in objects
        }

    def newest(self) -> list[Frame]:
        """Returns the frames that came since the last call, one per object at most; never waits."""
        frames = []
        for name, ring in self._rings.items():
            sample = ring.try_recv()
            if sample is None:
                continue
            try:
                state = parse(pb.State, sample.payload, CHANNELS["state"].limit)
                check_header(state, object=name, incarnation=self._incarnation())
                frames.append(frame_of(state))
            except Refused as error:
                self._refusals.note("frames", error)
        return frames


class Poses:
    """The newest pose of each obstacle, in a ring of one sample per obstacle."""

    def __init__(
        self, session: zenoh.Session, server: str, obstacles: list[str], incarnation: Incarnation = unknown
    ) -> None:  # fmt: skip
        self._incarnation, self._refusals = incarnation, _Refusals()
        self._rings = {
            name: session.declare_subscriber(key("pose", server, object=name), zenoh.handlers.RingChannel(1))
            for name in obstacles
        }

    def newest(self) -> list[ObstacleFrame]:
        """Returns the poses that came since the last call, one per obstacle at most; never waits."""
        found = []
        for name, ring in self._rings.items():
            sample = ring.try_recv()
            if sample is None:
                continue
            try:
                pose = parse(pb.ObstaclePose, sample.payload, CHANNELS["pose"].limit)
                check_header(pose, object=name, incarnation=self._incarnation())
                found.append(obstacle_frame_of(pose))
            except Refused as error:
                self._refusals.note("poses", error)
        return found


class Gaps:
    """Counts messages of a channel that did not come, by their sequence numbers."""

    def __init__(self, channel: str) -> None:
        self.lost = 0
        self._channel = channel
        self._incarnation = self._next = 0

    def note(self, header: pb.Header) -> None:
        """Takes the header of the next message; the first loss is logged."""
        if header.incarnation == self._incarnation and header.sequence > self._next:
            if not self.lost:
                log.warning("messages of the channel %s did not come in time; further ones are counted", self._channel)
            self.lost += header.sequence - self._next
        self._incarnation, self._next = header.incarnation, header.sequence + 1


class ReactionBatches:
    """Every message of the channel reactions as it comes.

    take: called with it and time.monotonic(), by zenoh
    incarnation: returns that of the server whose messages count; anybody may send some in its name
    """

    def __init__(
        self, session: zenoh.Session, server: str, take: Callable[[pb.Steps, float], None],
        incarnation: Callable[[], int],
    ) -> None:  # fmt: skip
        self._take, self._gaps, self._incarnation = take, Gaps("reactions"), incarnation
        self._refusals = _Refusals()
        self._lock = threading.Lock()
        self._subscriber = session.declare_subscriber(key("reactions", server), self._read)

    @property
    def lost(self) -> int:
        """Messages that did not come."""
        return self._gaps.lost

    def close(self) -> None:
        """Ends the subscription."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _read(self, sample: zenoh.Sample) -> None:
        now = time.monotonic()
        try:
            batch = parse(pb.Steps, sample.payload, CHANNELS["reactions"].limit)
            check_header(batch, incarnation=self._incarnation())
            check_numbers(batch)
        except Refused as error:
            self._refusals.note("forces", error)
            return
        with self._lock:
            self._gaps.note(batch.header)
            self._take(batch, now)


class Steps:
    """Batches of scalars per step. channel: steps or reactions. batches: that are kept."""

    def __init__(
        self, session: zenoh.Session, server: str, channel: str = "steps", batches: int = BATCHES,
        incarnation: Incarnation = unknown,
    ) -> None:  # fmt: skip
        self._incarnation, self._refusals = incarnation, _Refusals()
        self._channel, self._gaps = channel, Gaps(channel)
        self._ring = session.declare_subscriber(key(channel, server), zenoh.handlers.RingChannel(batches))

    @property
    def lost(self) -> int:
        """Messages that did not come, or were dropped here since `new` was called too seldom."""
        return self._gaps.lost

    def new(self) -> list[pb.ObjectStep]:
        """Returns the steps that came since the last call, oldest first; never waits."""
        steps: list[pb.ObjectStep] = []
        while (sample := self._ring.try_recv()) is not None:
            try:
                batch = parse(pb.Steps, sample.payload, CHANNELS[self._channel].limit)
                check_header(batch, incarnation=self._incarnation())
                self._gaps.note(batch.header)
                steps.extend(batch.steps)
            except Refused as error:
                self._refusals.note("steps", error)
        return steps
