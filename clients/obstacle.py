# SPDX-License-Identifier: MIT
"""The handle of an obstacle that clients move."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from clients.errors import BadInput
from clients.forces import Forces, Vector
from clients.log.obstacles import Obstacle as Shape
from protocol import messages_pb2 as pb


class Sender(Protocol):
    """What an obstacle uses of a Client."""

    timeout: float

    @property
    def forces(self) -> Forces: ...

    def command(self, verb: str, interaction: None = None, target: pb.ObstacleTarget | None = None) -> pb.Reply: ...

    def send(
        self, verb: str, interaction: None = None, answered: Callable[[pb.Reply | None], None] = ...,
        target: pb.ObstacleTarget | None = None,
    ) -> int: ...  # fmt: skip


class Obstacle:
    """Handle of an obstacle, from Client.obstacle. shape: what it is and where it was at the start."""

    def __init__(self, sender: Sender, shape: Shape) -> None:
        self._sender = sender
        self.shape = shape
        self.name = shape.name
        self._refusal = ""  # of a move that was not waited for

    def move(
        self, position: Sequence[float], rotation: Sequence[float] | None = None, wait: bool = False
    ) -> int | None:
        """Has the obstacle go to `position` [m] and turn to `rotation`, a unit quaternion w, x, y, z; None: as before.

        It goes at the speeds that the scene allows, max_speed and max_turn. Does not wait for the answer unless `wait`,
        so that it may be called 1000 times a second: returns the number of the move, and a refusal is raised by the
        next call. Raises BadInput.
        """
        if self._refusal:
            refusal, self._refusal = self._refusal, ""
            raise BadInput(f"move_obstacle: {refusal}")
        target = pb.ObstacleTarget(obstacle=self.name, position=_vector(position))
        if rotation is not None:
            target.rotation.CopyFrom(_quaternion(rotation))
        if wait:
            self._sender.command("move_obstacle", target=target)
            return None
        return self._sender.send("move_obstacle", answered=self._answered, target=target)

    @property
    def force(self) -> Vector:
        """What all objects exert on it in the newest step [N]. The first call waits for one. Raises ClientError."""
        return self._sender.forces.obstacle(self.name, self._sender.timeout).force

    @property
    def torque(self) -> Vector:
        """As `force`, about its position at the end of the step [N m]."""
        return self._sender.forces.obstacle(self.name, self._sender.timeout).torque

    def _answered(self, reply: pb.Reply | None) -> None:
        if reply is not None and reply.error:
            self._refusal = reply.error


def turned(angles: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns the unit quaternion of a rotation about the fixed axes x, then y, then z, as scenes have it [degrees]."""
    (ca, cb, cc), (sa, sb, sc) = ([f(math.radians(a) / 2) for a in angles] for f in (math.cos, math.sin))
    return (
        ca * cb * cc + sa * sb * sc,
        sa * cb * cc - ca * sb * sc,
        ca * sb * cc + sa * cb * sc,
        ca * cb * sc - sa * sb * cc,
    )


def _vector(position: Sequence[float]) -> pb.Vector:
    x, y, z = _finite(position, 3, "position", "three finite numbers")
    return pb.Vector(x=x, y=y, z=z)


def _quaternion(rotation: Sequence[float]) -> pb.Quaternion:
    """Returns four numbers as a message."""
    allowed = "four finite numbers, a quaternion w x y z of length 1"
    w, x, y, z = _finite(rotation, 4, "rotation", allowed)
    if not abs(math.hypot(w, x, y, z) - 1) < 1e-6:
        raise BadInput(f"rotation {w} {x} {y} {z}: allowed are {allowed}")
    return pb.Quaternion(w=w, x=x, y=y, z=z)


def _finite(values: Sequence[float], count: int, what: str, allowed: str) -> list[float]:
    numbers = [float(value) for value in values]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise BadInput(f"{what} {' '.join(map(str, numbers))}: allowed are {allowed}")
    return numbers
