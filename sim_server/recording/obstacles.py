# SPDX-License-Identifier: MIT
"""Converts obstacles, their poses and where clients want them to messages."""

from collections.abc import Mapping, Sequence

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.scene.motion import Keyframe
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.pose import quaternion
from sim_server.simulation import Simulation


def obstacle_messages(simulation: Simulation) -> list[pb.Obstacle]:
    """Converts all obstacles, with their poses as they are now. Call it before the first step."""
    if simulation.contact is None:
        return []
    found = []
    for obstacle, at in zip(simulation.world.obstacles, _poses(simulation), strict=True):
        position, rotation = pose_message(at)
        message = pb.Obstacle(
            header=pb.Header(object=obstacle.name), shape=obstacle.shape, size=_size(obstacle),
            moved="keyframes" if obstacle.keyframes else obstacle.moved or "", position=position, rotation=rotation,
        )  # fmt: skip
        if obstacle.file is not None:
            from sim_server.mechanics.signed_distance import read_surface

            points, triangles = read_surface(obstacle.file)
            message.vertices = np.ascontiguousarray(points * (obstacle.scale or 1.0), "<f8").tobytes()
            message.triangles = np.ascontiguousarray(triangles, "<i4").tobytes()
        found.append(message)
    return found


def pose_messages(simulation: Simulation, step: int, fixed: bool = False) -> list[pb.ObstaclePose]:
    """Converts the poses of obstacles that move, after `step` steps. fixed: of all.

    Of an obstacle that clients move it is the pose as it is now: a loop may have gone on meanwhile.
    """
    if simulation.contact is None:
        return []
    found, time = [], step * simulation.world.dt
    for obstacle, at in zip(simulation.world.obstacles, _poses(simulation), strict=True):
        if fixed or obstacle.keyframes or obstacle.moved:
            position, rotation = pose_message(_at(obstacle.keyframes, time) if obstacle.keyframes else at)
            header = pb.Header(object=obstacle.name)
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


def _poses(simulation: Simulation) -> Float64:
    """Poses (m, 7) at the end of the step that the loop has begun last, which may be changing as they are read."""
    assert simulation.contact is not None
    poses = simulation.world.backend.fetch(simulation.contact.contact_input().obstacles.end).copy()
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def _at(keyframes: Sequence[Keyframe], time: float) -> Float64:
    """Pose (7,) between keyframes at a time [s], as `pose_at` in effects/contact.cu has it."""
    after = next((k for k, key in enumerate(keyframes) if key.time > time), len(keyframes))
    a, b = keyframes[max(after - 1, 0)], keyframes[min(after, len(keyframes) - 1)]
    part = (time - a.time) / (b.time - a.time) if a is not b else 0.0
    position = np.array(a.translate) + part * (np.array(b.translate) - np.array(a.translate))
    p, q = np.array(quaternion(a.rotate)), np.array(quaternion(b.rotate))
    q = -q if p @ q < 0 else q
    aside = q - (p @ q) * p
    size = float(np.linalg.norm(aside))
    angle = part * float(np.arctan2(size, p @ q))
    rotation = np.cos(angle) * p + (np.sin(angle) / size * aside if size > 0 else 0.0)
    return np.concatenate([position, rotation / np.linalg.norm(rotation)])


def _size(obstacle: Obstacle) -> Sequence[float]:
    """Sizes [m], as pb.Obstacle has them."""
    return obstacle.size or [value for value in (obstacle.radius, obstacle.length) if value is not None]
