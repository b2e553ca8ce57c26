# SPDX-License-Identifier: MIT
"""What a server sends by itself, received so that a slow reader gets the newest and never a backlog."""

from __future__ import annotations

import logging

import zenoh

from clients.frames import Frame, frame_of
from protocol import Refused
from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, key
from protocol.check import check_header, parse

BATCHES = 64  # of steps that a reader may be behind, about 3 s

log = logging.getLogger(__name__)


class States:
    """Newest frame of each object. One ring of one sample per object: none can push another out."""

    def __init__(self, session: zenoh.Session, server: str, objects: list[str]) -> None:
        self._rings = {
            name: session.declare_subscriber(key("state", server, object=name), zenoh.handlers.RingChannel(1))
            for name in objects
        }

    def newest(self) -> list[Frame]:
        """One frame per object that has a new one since the last call; never waits."""
        frames = []
        for name, ring in self._rings.items():
            sample = ring.try_recv()
            if sample is None:
                continue
            try:
                state = parse(pb.State, sample.payload, CHANNELS["state"].limit)
                check_header(state, object=name)
                frames.append(frame_of(state))
            except Refused as error:
                log.warning("a frame was left out: %s", error)
        return frames


class Steps:
    """Batches of per-step scalars."""

    def __init__(self, session: zenoh.Session, server: str) -> None:
        self._ring = session.declare_subscriber(key("steps", server), zenoh.handlers.RingChannel(BATCHES))

    def new(self) -> list[pb.ObjectStep]:
        """All steps that came since the last call, oldest first; never waits."""
        steps: list[pb.ObjectStep] = []
        while (sample := self._ring.try_recv()) is not None:
            try:
                batch = parse(pb.Steps, sample.payload, CHANNELS["steps"].limit)
                check_header(batch)
                steps.extend(batch.steps)
            except Refused as error:
                log.warning("steps were left out: %s", error)
        return steps
