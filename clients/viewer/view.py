# SPDX-License-Identifier: MIT
"""Shows a run in the rerun viewer, from a log or live from a server; saves a log as a file of rerun or an image."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.atomic_file import atomic_file
from clients.log.reader import Log
from clients.log.scalars import columns, row
from clients.progress import progress_bar
from clients.viewer.image_io import encoded, kind_of
from clients.viewer.rerun_viewer import Viewer, has_display
from clients.viewer.screenshot import has_vulkan_driver, screenshot
from clients.viewer.surface import Coloring, Surface
from protocol.process.extras import to_install

if TYPE_CHECKING:
    import rerun as rr

    from clients.viewer.rerun_scene import RerunScene

SAMPLES = 64  # frames of an object from which the limit of the colours is taken
LIVE_PERIOD = 1 / 30  # s between two readings of new frames


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def color_limit(log: Log, coloring: Coloring) -> float:
    """Returns the value of the last colour: the largest one in SAMPLES evenly spaced frames.

    For the stress the largest 99th percentile, as it is unbounded at corners and clamped edges.
    """
    top = 0.0
    for name, found in log.objects.items():
        count = len(found.frames)
        epoch = -1
        surface: Surface | None = None
        for index in np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).astype(int)) if count else ():
            frame = log.frame(name, int(index))
            if surface is None or epoch != frame.epoch:
                epoch, surface = frame.epoch, Surface(log.mesh(name, frame.epoch), coloring)
            values = surface.values(frame.x)
            if len(values) and np.isfinite(values).all():
                top = max(top, float(values.max() if coloring == "displacement" else np.percentile(values, 99)))
    return top


def show_log(log: Log, recording: rr.RecordingStream, coloring: Coloring) -> None:
    """Sends a log to a recording: frames, curves, layout."""
    from clients.viewer.rerun_scene import RerunScene

    scene = RerunScene(recording, coloring, color_limit(log, coloring))
    skipped = 0
    with progress_bar("converting", sum(len(found.frames) for found in log.objects.values())) as progress:
        done = 0
        for name in sorted(log.objects):
            for frame in log.frames(name):
                skipped += not scene.frame(frame, log.mesh(name, frame.epoch))
                done += 1
                progress(done)
    for obstacle in log.obstacles.values():
        scene.obstacle(obstacle)
        for pose in log.poses.get(obstacle.name, ()):
            scene.pose(pose)
    for number, name in enumerate(sorted(log.objects)):
        scene.steps(name, log.scalars(name), step_time=number == 0)
    if skipped:
        say(f"{log.path}: {skipped} frames with NaN or infinite positions are not shown")
    recording.send_blueprint(scene.blueprint())


def save_rrd(log: Log, to: Path, coloring: Coloring) -> None:
    """Writes the log as a file of the rerun viewer. Raises ClientError.

    The file is written here: when the disk is full, rerun leaves a short file or never ends.
    """
    recording = _recording()
    import rerun as rr

    stream = rr.binary_stream(recording)
    try:
        with atomic_file(to) as part:
            part.touch()  # a bad path is reported before the conversion
            show_log(log, recording, coloring)
            part.write_bytes(stream.read() or b"")
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None
    finally:
        recording.disconnect()


def write_recording(log: Log, to: BinaryIO, application: str, recording_id: str | None) -> None:
    """Writes the log as a recording of rerun to a stream, under the names that rerun gives. Raises OSError."""
    recording = _recording(application, recording_id)
    import rerun as rr

    stream = rr.binary_stream(recording)
    try:
        show_log(log, recording, "displacement")
        to.write(stream.read() or b"")
        to.flush()
    finally:
        recording.disconnect()


def save_screenshot(log: Log, to: Path, coloring: Coloring) -> None:
    """Writes an image of the last frame: by the viewer, or by matplotlib where the viewer cannot run.

    PNG or JPEG, as the suffix says. Raises BadInput for another one, ClientError.
    """
    kind = kind_of(to)
    steps = [found.frames[-1][0] for found in log.objects.values() if found.frames]
    if not steps:
        raise BadInput(f"{log.path}: no frames were recorded")
    picture = b""
    if has_vulkan_driver():
        with tempfile.TemporaryDirectory() as folder:
            rrd = Path(folder) / "run.rrd"
            save_rrd(log, rrd, coloring)
            try:
                picture = screenshot(rrd, max(steps))
            except ClientError as error:
                say(f"{error}; drawn by matplotlib instead")
    else:
        say("no Vulkan driver here (Debian: mesa-vulkan-drivers), so the picture is drawn by matplotlib")
    if not picture:
        from clients.viewer.snapshot_plot import draw

        picture = draw(log, coloring, color_limit(log, coloring))
    picture = encoded(picture, kind)
    try:
        with atomic_file(to) as part:
            part.write_bytes(picture)
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None


def view_log(log: Log, coloring: Coloring, web: bool) -> None:
    """Shows the log until the viewer is closed."""
    with _viewer(web) as viewer, _connected_to(viewer) as recording:
        show_log(log, recording, coloring)
        recording.flush()
        viewer.wait()


def view_live(client: Client, coloring: Coloring, web: bool) -> None:
    """Shows a running server until the viewer is closed."""
    from clients.viewer.rerun_scene import RerunScene

    with _viewer(web) as viewer, _connected_to(viewer) as recording:
        follow(client, RerunScene(recording, coloring, grow=True), viewer, recording)


def follow(client: Client, scene: RerunScene, viewer: Viewer, recording: rr.RecordingStream) -> None:
    """Logs states and steps of a server to a recording until the viewer is closed."""
    meshes, obstacles = client.meshes(), client.obstacles()
    states, steps, poses = client.states(), client.steps(), client.poses()
    first = min(meshes, default="")
    laid_out = -1  # quantities that the layout has
    while viewer.running():
        frames = states.newest()
        for frame in frames:
            mesh = meshes.get(frame.object)
            if mesh is None or mesh.epoch != frame.epoch:  # of a new epoch
                meshes = client.meshes()
                mesh = meshes.get(frame.object)
            if mesh and mesh.epoch == frame.epoch and len(mesh.rest) == len(frame.x):
                scene.frame(frame, mesh)
        by_object: dict[str, list[tuple]] = {}
        for step in steps.new():
            by_object.setdefault(step.header.object, []).append(row(step))
        for name, rows in by_object.items():
            scene.steps(name, columns(rows), step_time=name == first)
        if frames and laid_out < scene.quantities:
            for obstacle in obstacles.values() if laid_out < 0 else ():
                scene.obstacle(obstacle)
            recording.send_blueprint(scene.blueprint())
            laid_out = scene.quantities
        for pose in poses.newest():
            scene.pose(pose)
        time.sleep(LIVE_PERIOD)


def _viewer(web: bool) -> Viewer:
    served = not web and not has_display()
    viewer = Viewer(web or served)
    if served:
        say("no display here, so the viewer is served as a page")
    if viewer.page:
        say(f"open {viewer.page} in a browser on this machine; Ctrl-C ends the viewer")
    return viewer


@contextmanager
def _connected_to(viewer: Viewer) -> Iterator[rr.RecordingStream]:
    """Yields a recording that is closed before its viewer, which would report a lost connection otherwise."""
    recording = _recording()
    recording.connect_grpc(viewer.url)
    try:
        yield recording
    finally:
        recording.disconnect()


def _recording(application: str = "warpfactor", recording_id: str | None = None) -> rr.RecordingStream:
    os.environ.setdefault("RUST_LOG", "error")  # read by rerun when it is imported; its warnings are handled here
    try:
        import rerun as rr
    except ImportError:
        raise ClientError(f"rerun-sdk is not installed, of the extra view: {to_install('view')}") from None
    return rr.RecordingStream(application, recording_id=recording_id)
