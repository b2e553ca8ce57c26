# SPDX-License-Identifier: MIT
"""A WebSocket server that shows a running sim-server in Foxglove and Lichtblick."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import foxglove
import numpy as np
from numpy.typing import NDArray

from clients.client import Client
from clients.errors import ClientError
from clients.export.foxglove_layout import layout
from clients.export.foxglove_scene import FoxgloveScene
from clients.log.atomic_file import atomic_file
from clients.log.frames import Frame, Mesh
from clients.log.obstacles import Pose

PERIOD = 1 / 30  # s between two readings of new frames
AGAIN = 1.0  # s after which what stands still is sent once more, for those who came since


def serve(
    client: Client, host: str, port: int, ready: Callable[[int], None], running: Callable[[], bool] = lambda: True
) -> None:
    """Serves states, steps and obstacles of a server until `running` says no; a message has the time at which it came.

    port: 0 takes a free one. ready: gets the port. It takes nothing from those who connect.
    Raises ClientError if the port is taken or the server does not answer.
    """
    context = foxglove.Context()
    meshes = client.meshes()
    scene = FoxgloveScene(context, lambda _: time.time_ns())
    scene.announce(meshes)
    try:
        server = foxglove.start_server(name=f"sim-server {client.name}", host=host, port=port, context=context)
    except (OSError, RuntimeError) as error:
        raise ClientError(f"cannot listen on {host}:{port}: {error}") from None
    try:
        ready(server.port)
        _follow(client, scene, meshes, running)
    finally:
        server.stop()


def write_layout(client: Client, to: Path) -> None:
    """Writes a layout for the objects of a server. Raises ClientError."""
    try:
        with atomic_file(to) as part:
            part.write_text(layout(sorted(client.meshes())))
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None


def _follow(client: Client, scene: FoxgloveScene, meshes: dict[str, Mesh], running: Callable[[], bool]) -> None:
    obstacles, box = client.obstacles(), _box(meshes)
    placed: dict[str, Pose] = {name: obstacle.start for name, obstacle in obstacles.items()}
    for obstacle in obstacles.values():
        scene.obstacle(obstacle, box)
    states, steps, poses = client.states(), client.steps(), client.poses()
    frames: dict[str, Frame] = {}
    due = 0.0
    while running():
        new = states.newest()
        for frame in new:
            frames[frame.object] = frame
            if not _fits(meshes.get(frame.object), frame):  # of a new epoch, or of a server that was started again
                meshes = client.meshes()
        for step in steps.new():
            scene.step(step)
        moved = {found.obstacle: found.pose for found in poses.newest()}
        placed |= moved
        again = time.monotonic() >= due
        if again:
            due = time.monotonic() + AGAIN
            scene.upright(0.0)
        for frame in frames.values() if again else new:
            mesh = meshes.get(frame.object)
            if mesh is not None and _fits(mesh, frame):
                scene.frame(frame, mesh)
        for name, pose in (placed if again else moved).items():
            scene.pose(name, pose, 0.0)
        time.sleep(PERIOD)


def _fits(mesh: Mesh | None, frame: Frame) -> bool:
    return mesh is not None and mesh.epoch == frame.epoch and len(mesh.rest) == len(frame.x)


def _box(meshes: dict[str, Mesh]) -> tuple[NDArray, NDArray]:
    """Returns the corners of a box around the bodies at rest [m]."""
    rest = [mesh.rest for mesh in meshes.values()]
    if not rest:
        return np.zeros(3), np.ones(3)
    return np.min([x.min(axis=0) for x in rest], axis=0), np.max([x.max(axis=0) for x in rest], axis=0)
