# SPDX-License-Identifier: MIT
"""Obstacles of the made-up run, and steps that touch them, exact in every value."""

from __future__ import annotations

from pathlib import Path

from protocol import messages_pb2 as pb
from tests.sample_run import DT, REST, TRIANGLES, header, object_step, scene, state, topology

HALF = 0.5**0.5  # of a quarter turn, cosine and sine of half of it
SHAPES = ("floor", "ball", "block", "tool", "bowl")
MOVED = {"tool": "client", "block": "keyframes"}


def obstacle(name: str) -> pb.Obstacle:
    shape, size = {
        "floor": ("plane", ()), "ball": ("sphere", (0.5,)), "block": ("box", (1.0, 2.0, 3.0)),
        "tool": ("capsule", (0.25, 2.0)), "bowl": ("grid", ()),
    }[name]  # fmt: skip
    message = pb.Obstacle(
        header=header(name), shape=shape, size=size, moved=MOVED.get(name, ""), position=pb.Vector(y=-1.0),
        rotation=pb.Quaternion(w=HALF, x=HALF),
    )  # fmt: skip
    if shape == "grid":
        message.vertices = REST.astype("<f8").tobytes()
        message.triangles = TRIANGLES.astype("<i4").tobytes()
    return message


def pose(name: str, step: int) -> pb.ObstaclePose:
    """Rises by 1/8 m a step."""
    position, rotation = pb.Vector(y=-1.0 + step / 8), pb.Quaternion(w=HALF, x=HALF)
    return pb.ObstaclePose(header=header(name), step=step, time=step * DT, position=position, rotation=rotation)


def touching_step(name: str, step: int) -> pb.ObjectStep:
    """Touches the tool from step 3 on, and in step 5 the floor too."""
    message = object_step(name, step)
    if step >= 3:
        message.contacts, message.passes, message.contact_residual = step, 2, 0.125 / step
        message.reactions.add(obstacle="tool", force=pb.Vector(x=3.0, z=4.0 * step), torque=pb.Vector(y=0.5))
    if step == 5:
        message.clipped, message.status = 1, pb.CONTACT
        message.reactions.add(obstacle="floor", force=pb.Vector(y=-7.0))
    return message


def record_contact(path: Path, steps: int) -> Path:
    """Records frames 0..steps and steps 1..steps of a beam among obstacles."""
    from sim_server.recording.recorder import Recorder

    with Recorder(path) as recorder:
        found = scene(["beam"])
        found.obstacles.extend(SHAPES)
        recorder.scene(found)
        recorder.topology(topology("beam"))
        for name in SHAPES:
            recorder.obstacle(obstacle(name))
        for step in range(steps + 1):
            if step:
                recorder.step(touching_step("beam", step), block=True)
            recorder.state(state("beam", step), block=True)
            for name in MOVED:
                recorder.pose(pose(name, step), block=True)
    return path
