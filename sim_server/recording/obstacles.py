# SPDX-License-Identifier: MIT
"""Converts obstacles, their poses and where clients want them to messages."""

from collections.abc import Sequence

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.scene.obstacles import Obstacle
from sim_server.simulation import Simulation


def obstacle_messages(simulation: Simulation) -> list[pb.Obstacle]:
    """Converts all obstacles, with their poses as they are now. Call it before the first step."""
    contact = simulation.contact
    if contact is None:
        return []
    found = []
    for number, (obstacle, at) in enumerate(zip(_obstacles(simulation), _poses(simulation), strict=True)):
        position, rotation = pose_message(at)
        message = pb.Obstacle(
            header=pb.Header(object=obstacle.name), shape=obstacle.shape, size=_size(obstacle),
            moved="keyframes" if obstacle.keyframes else obstacle.moved or "", position=position, rotation=rotation,
        )  # fmt: skip
        if obstacle.shape == "grid":
            vertices, triangles = contact.surface(number)
            message.vertices = np.ascontiguousarray(vertices, "<f8").tobytes()
            message.triangles = np.ascontiguousarray(triangles, "<i4").tobytes()
        found.append(message)
    return found


def pose_messages(simulation: Simulation, step: int, fixed: bool = False) -> list[pb.ObstaclePose]:
    """Converts the poses as they are now of obstacles that move. step: number of completed steps. fixed: of all."""
    if simulation.contact is None:
        return []
    found = []
    for obstacle, at in zip(_obstacles(simulation), _poses(simulation), strict=True):
        if fixed or obstacle.keyframes or obstacle.moved:
            position, rotation = pose_message(at)
            header, time = pb.Header(object=obstacle.name), step * simulation.world.dt
            found.append(pb.ObstaclePose(header=header, step=step, time=time, position=position, rotation=rotation))
    return found


def pose_message(pose: Float64) -> tuple[pb.Vector, pb.Quaternion]:
    """Converts a pose, position [m] and unit quaternion w, x, y, z (7,)."""
    px, py, pz, w, x, y, z = map(float, pose)
    return pb.Vector(x=px, y=py, z=pz), pb.Quaternion(w=w, x=x, y=y, z=z)


def _obstacles(simulation: Simulation) -> Sequence[Obstacle]:
    return simulation.scene.obstacles or ()


def _poses(simulation: Simulation) -> Float64:
    """Poses (m, 7) at the end of the last step."""
    assert simulation.contact is not None
    return simulation.world.backend.fetch(simulation.contact.contact_input().obstacles.end)


def _size(obstacle: Obstacle) -> Sequence[float]:
    """Sizes [m], as pb.Obstacle has them."""
    return obstacle.size or [value for value in (obstacle.radius, obstacle.length) if value is not None]
