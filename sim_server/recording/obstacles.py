# SPDX-License-Identifier: MIT
"""Converts obstacles and holders, their poses and where clients want them to messages."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.scene.obstacles import Obstacle
from sim_server.simulation import Simulation

if TYPE_CHECKING:
    from sim_server.effects._movable import Movable


def obstacle_messages(simulation: Simulation) -> list[pb.Obstacle]:
    """Converts all obstacles and holders, with their poses as they are now. Call it before the first step."""
    found = [_holder_message(*each) for each in _placed(simulation, simulation.holders)]
    for obstacle, at in _placed(simulation, simulation.contact):
        position, rotation = pose_message(at)
        message = pb.Obstacle(
            header=pb.Header(object=obstacle.name), shape=obstacle.shape, size=_size(obstacle),
            moved="keyframes" if obstacle.keyframes else obstacle.moved or "", position=position, rotation=rotation,
        )  # fmt: skip
        if obstacle.file is not None:
            from sim_server.mesh.surface_file import read_surface

            points, triangles = read_surface(obstacle.file)
            message.vertices = np.ascontiguousarray(points * (obstacle.scale or 1.0), "<f8").tobytes()
            message.triangles = np.ascontiguousarray(triangles, "<i4").tobytes()
        found.append(message)
    return found


def pose_messages(
    simulation: Simulation, step: int, poses: Float64 | None = None, fixed: bool = False
) -> list[pb.ObstaclePose]:
    """Converts the poses of obstacles and holders that move, after `step` steps. fixed: of all.

    poses: (m, 7) of the obstacles in the frame of that step. None, and holders: of what clients move it is the pose as
    it is now; a loop may have gone on meanwhile.
    """
    found, time = [], step * simulation.world.dt
    for mover, of_frame in ((simulation.contact, poses), (simulation.holders, None)):
        for listed, at in _placed(simulation, mover, of_frame):
            if fixed or listed.keyframes or listed.moved:
                assert mover is not None
                position, rotation = pose_message(mover.pose_at(listed.name, time) if listed.keyframes else at)
                header = pb.Header(object=listed.name)
                found.append(pb.ObstaclePose(header=header, step=step, time=time, position=position, rotation=rotation))
    return found


def pose_message(pose: Float64) -> tuple[pb.Vector, pb.Quaternion]:
    """Converts a pose, position [m] and unit quaternion w, x, y, z (7,)."""
    px, py, pz, w, x, y, z = pose.tolist()
    return pb.Vector(x=px, y=py, z=pz), pb.Quaternion(w=w, x=x, y=y, z=z)


def target_messages(step: int, targets: Mapping[str, Float64]) -> pb.ObstacleTargets:
    """Converts the poses (7,) that clients want, which the loop took up after `step` steps."""
    found = pb.ObstacleTargets(step=step)
    for name, pose in targets.items():
        position, rotation = pose_message(pose)
        found.targets.add(obstacle=name, position=position, rotation=rotation)
    return found


def targets_of(message: pb.ObstacleTargets) -> dict[str, Float64]:
    """Returns the poses of `target_messages` (7,)."""
    return {
        t.obstacle: np.array(
            [t.position.x, t.position.y, t.position.z, t.rotation.w, t.rotation.x, t.rotation.y, t.rotation.z]
        )
        for t in message.targets
    }


def _holder_message(holder: Any, at: Float64) -> pb.Obstacle:
    position, rotation = pose_message(at)
    moved = "keyframes" if holder.keyframes else holder.moved or ""
    return pb.Obstacle(
        header=pb.Header(object=holder.name), shape="holder", moved=moved, position=position, rotation=rotation
    )


def _placed(simulation: Simulation, mover: "Movable | None", poses: Float64 | None = None) -> list[tuple[Any, Float64]]:
    """Tables of what an effect moves, each with its pose (7,).

    poses: (m, 7) of all. None: at the end of the step that the loop has begun last, which may be changing as it is
    read.
    """
    if mover is None:
        return []
    poses = (simulation.world.backend.fetch(mover.end) if poses is None else poses).copy()
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return list(zip(mover.listed, poses, strict=True))


def _size(obstacle: Obstacle) -> Sequence[float]:
    """Sizes [m], as pb.Obstacle has them."""
    return obstacle.size or [value for value in (obstacle.radius, obstacle.length) if value is not None]
