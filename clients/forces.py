# SPDX-License-Identifier: MIT
"""The forces of the newest step: on obstacles, on grabs, and between objects."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import zenoh

from clients.errors import ClientError
from clients.subscriptions import ReactionBatches
from protocol import messages_pb2 as pb

Vector = tuple[float, float, float]


class Load(NamedTuple):
    """What objects exerted on something in a step. point: about which the torque is; None: see the kind."""

    step: int
    force: Vector  # N
    torque: Vector  # N m
    point: Vector | None  # m


class Forces:
    """Listens to the channel `reactions`, and keeps the newest step of each object.

    incarnation: returns that of the server
    on_batch: called in a thread of zenoh's with each message as it comes, and the time.monotonic() of that
    """

    def __init__(
        self, session: zenoh.Session, server: str, incarnation: Callable[[], int],
        on_batch: Callable[[pb.Steps, float], None] | None = None,
    ) -> None:  # fmt: skip
        self._newest: dict[str, pb.ObjectStep] = {}
        self._step = -1
        self._changed = threading.Condition()
        self._on_batch = on_batch
        self._batches = ReactionBatches(session, server, self._take, incarnation)

    @property
    def lost(self) -> int:
        """Messages that did not come."""
        return self._batches.lost

    def obstacle(self, name: str, timeout: float) -> Load:
        """Returns the sum over objects; the torque is about the position of the obstacle. Raises ClientError."""
        return self._sum(lambda r: r.obstacle == name, timeout)

    def grab(self, id: int, timeout: float) -> Load:
        """Returns what the object exerts on the hand. Waits for a step with the grab. Raises ClientError."""
        return self._sum(lambda r: r.HasField("grab") and r.grab == id, timeout, seen=True)

    def between(self, first: str, second: str, timeout: float) -> Load:
        """Returns what object `first` exerts on object `second`. Raises ClientError."""
        return self._sum(lambda r: r.object == second, timeout, of=first)

    def close(self) -> None:
        """Ends the subscription."""
        self._batches.close()

    def _take(self, batch: pb.Steps, now: float) -> None:
        with self._changed:
            for step in batch.steps:
                self._newest[step.header.object] = step
                self._step = step.step
            self._changed.notify_all()
        if self._on_batch is not None:
            self._on_batch(batch, now)

    def _sum(self, wanted: Callable[[pb.Reaction], bool], timeout: float, of: str = "", seen: bool = False) -> Load:
        """Adds up what the newest step has. seen: wait until there is something."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                found = list(self._reactions(wanted, of))
                if self._step >= 0 and (found or not seen):
                    break
                left = end - time.monotonic()
                if left <= 0:
                    raise ClientError(f"no step with forces came within {timeout:g} s; is the simulation paused?")
                self._changed.wait(left)
            step = self._step
        force, torque = (_added(getattr(r, name) for r in found) for name in ("force", "torque"))
        point = _three(found[0].point) if len(found) == 1 and found[0].HasField("point") else None
        return Load(step, force, torque, point)

    def _reactions(self, wanted: Callable[[pb.Reaction], bool], of: str) -> Iterator[pb.Reaction]:
        for name, step in self._newest.items():
            if of in ("", name) and step.step == self._step:
                yield from filter(wanted, step.reactions)


def _three(v: pb.Vector) -> Vector:
    return v.x, v.y, v.z


def _added(vectors: Iterator[pb.Vector]) -> Vector:
    x = y = z = 0.0
    for v in vectors:
        x, y, z = x + v.x, y + v.y, z + v.z
    return x, y, z
