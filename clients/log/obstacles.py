# SPDX-License-Identifier: MIT
"""Obstacle and ObstaclePose messages as checked values."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.refused import Refused
from protocol.validate import array, check_range

SIZES = {"plane": 0, "sphere": 1, "box": 3, "capsule": 2, "grid": 0, "holder": 0}
"""Shapes, and how many sizes [m] each has: radius; lengths along x, y, z; radius and length of the axis along y. A
holder is a group of an object's nodes, and has no surface."""

Position = tuple[float, float, float]
Rotation = tuple[float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """Where an obstacle is: a point p of its own frame is at rotation p + position."""

    position: Position  # m
    rotation: Rotation  # unit quaternion w, x, y, z

    def matrix(self) -> NDArray[np.float64]:
        """Returns the rotation as a matrix (3, 3)."""
        w, x, y, z = self.rotation
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )


@dataclass(frozen=True)
class Obstacle:
    """A rigid shape that objects touch. A plane is the half-space below y = 0 of its own frame."""

    name: str
    shape: str  # one of SIZES
    size: tuple[float, ...]  # m
    vertices: NDArray[np.float64]  # (n, 3) surface of a grid [m]; of others empty
    triangles: NDArray[np.int32]  # (t, 3)
    moved: str  # "" (fixed) | "keyframes" | "client"
    start: Pose


@dataclass(frozen=True)
class ObstacleFrame:
    """Pose of an obstacle after a step."""

    obstacle: str
    step: int
    time: float  # s
    pose: Pose


def obstacle_of(message: pb.Obstacle) -> Obstacle:
    """Checks an obstacle. Raises Refused."""
    name = f"Obstacle {message.header.object!r}"
    size = tuple(message.size)
    if SIZES.get(message.shape) != len(size) or not all(0 <= value < math.inf for value in size):
        raise Refused(
            f"{name}: a {message.shape!r} of {size} m; allowed: {SIZES}, shapes with numbers of sizes", "shape"
        )
    vertices = array(message.vertices, np.float64, (-1, 3), f"{name}: vertices", finite=True)
    triangles = array(message.triangles, np.int32, (-1, 3), f"{name}: triangles")
    check_range(triangles, 0, len(vertices), f"{name}: triangles")
    start = _pose(message.position, message.rotation, name)
    return Obstacle(message.header.object, message.shape, size, vertices, triangles, message.moved, start)


def obstacle_frame_of(message: pb.ObstaclePose) -> ObstacleFrame:
    """Checks a pose. Raises Refused."""
    name = message.header.object
    pose = _pose(message.position, message.rotation, f"pose of {name!r} at step {message.step}")
    return ObstacleFrame(name, message.step, message.time, pose)


def _pose(position: pb.Vector, rotation: pb.Quaternion, what: str) -> Pose:
    found = Pose((position.x, position.y, position.z), (rotation.w, rotation.x, rotation.y, rotation.z))
    if not all(map(math.isfinite, found.position)) or not abs(math.hypot(*found.rotation) - 1) < 1e-6:
        raise Refused(f"{what}: {found}; allowed: finite numbers, and a quaternion of length 1", "not_finite")
    return found
