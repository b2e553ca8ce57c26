# SPDX-License-Identifier: MIT
"""Exports a log as an MCAP file for Foxglove and Lichtblick, with a layout beside it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import foxglove
from google.protobuf.message import DecodeError

from clients.export.box import box_of
from clients.export.foxglove_layout import layout
from clients.export.foxglove_scene import FoxgloveScene, reaction_topic
from clients.log.atomic_file import atomic_file
from clients.log.reader import Log
from clients.log.scalars import REACTION, READING
from clients.viewer.view import color_limit
from protocol import messages_pb2 as pb
from protocol.log_file import LogFile

PLOTTED = 8  # topics of a plot of reactions, and of one of readings


def write_foxglove(
    log: Log, names: Sequence[str], to: Path, progress: Callable[[float], None] = lambda _: None
) -> list[Path]:
    """Writes objects, all obstacles, and a layout; a message has the time at which the run began plus simulated time.

    Frames that are not finite are left out, which is said on stderr. Returns the files. Raises OSError.
    """
    start = log.scene.started_ns if log.scene is not None else 0
    plan = to.with_name(f"{to.name.removesuffix('.mcap').removesuffix('.foxglove')}.layout.json")
    with atomic_file(to) as part:
        part.touch()  # a bad path is reported as any other
        context = foxglove.Context()
        with foxglove.open_mcap(part, allow_overwrite=True, context=context):
            skipped = _write(
                log,
                names,
                FoxgloveScene(context, lambda t: start + round(t * 1e9), color_limit(log, "displacement")),
                progress,
            )
    with atomic_file(plan) as part:
        part.write_text(layout(names, _forces(log, names), _readings(log, names)))
    if skipped:
        print(f"{log.path}: {skipped} frames with NaN or infinite positions are left out", file=sys.stderr)
    return [plan, to]


def _forces(log: Log, names: Sequence[str]) -> list[str]:
    """Returns the first topics of reactions, as many as a plot shows."""
    ending = "/force_x"
    columns = ((n, c) for n in names for c in log.scalars(n) if c.startswith(REACTION) and c.endswith(ending))
    return [reaction_topic(n, c.removeprefix(REACTION).removesuffix(ending)) for n, c in columns][:PLOTTED]


def _readings(log: Log, names: Sequence[str]) -> list[str]:
    """Returns the first topics of readings, as many as a plot shows."""
    columns = ((n, c) for n in names for c in log.scalars(n) if c.startswith(READING))
    return [f"/reading/{n}/{c.removeprefix(READING)}" for n, c in columns][:PLOTTED]


def _write(log: Log, names: Sequence[str], scene: FoxgloveScene, progress: Callable[[float], None]) -> int:
    """Writes the messages in the order of the log, so that parts of the file are parts of the time."""
    first = min((log.frame(name, 0).time for name in names if log.object_log(name).frames), default=0.0)
    scene.upright(first)
    box = box_of(log, names)
    for obstacle in log.obstacles.values():
        scene.obstacle(obstacle, box)
        scene.pose(obstacle.name, obstacle.start, first)
    count, posed, done, skipped = dict.fromkeys(names, 0), dict.fromkeys(log.poses, 0), 0, 0
    with LogFile.open(log.path) as file:
        for message in file.messages():
            name = message.object
            if message.kind == "state" and name in count and count[name] < len(log.object_log(name).frames):
                frame = log.frame(name, count[name])
                skipped += not scene.frame(frame, log.mesh(name, frame.epoch))
                count[name] += 1
                done += 1
                progress(done)
            elif message.kind == "step" and name in count:
                _step(scene, message.data)
            elif message.kind == "pose" and name in posed and posed[name] < len(log.poses[name]):
                found = log.poses[name][posed[name]]
                scene.pose(name, found.pose, found.time)
                posed[name] += 1
    return skipped


def _step(scene: FoxgloveScene, data: bytes) -> None:
    try:
        scene.step(pb.ObjectStep.FromString(data))
    except DecodeError:
        return  # the notes of the log have it
