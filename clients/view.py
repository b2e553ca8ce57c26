# SPDX-License-Identifier: MIT
"""A run in the rerun viewer: from a log, to a file or a picture, or live from a server."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.export import written_whole
from clients.image_file import encoded, kind_of
from clients.log import Log
from clients.progress import progress_bar
from clients.rerun_viewer import Viewer, has_display
from clients.scalars import columns, row
from clients.screenshot import has_vulkan_driver, screenshot
from clients.surface import Coloring, Surface
from protocol.extras import to_install

if TYPE_CHECKING:
    import rerun as rr

    from clients.rerun_scene import RerunScene

SAMPLES = 64  # frames of an object looked at for the limit of the colours
LIVE_SECONDS = 1 / 30  # between two looks for new frames


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def color_limit(log: Log, coloring: Coloring) -> float:
    """Value of the last colour over the whole run: the largest of evenly chosen frames.

    Of the stress, the largest 99th percentile: it has no bound at corners and clamped edges.
    """
    top = 0.0
    for name, found in log.objects.items():
        count = len(found.frames)
        surfaces: dict[int, Surface] = {}
        for index in np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).astype(int)) if count else ():
            frame = log.frame(name, int(index))
            if frame.epoch not in surfaces:
                surfaces[frame.epoch] = Surface(log.mesh(name, frame.epoch), coloring)
            values = surfaces[frame.epoch].values(frame.x)
            if len(values) and np.isfinite(values).all():
                top = max(top, float(values.max() if coloring == "displacement" else np.percentile(values, 99)))
    return top


def show_log(log: Log, recording: rr.RecordingStream, coloring: Coloring) -> None:
    """Sends the whole log to a recording: frames, curves, layout."""
    from clients.rerun_scene import RerunScene

    scene = RerunScene(recording, coloring, color_limit(log, coloring))
    skipped = 0
    with progress_bar("converting", sum(len(found.frames) for found in log.objects.values())) as progress:
        done = 0
        for name in sorted(log.objects):
            for frame in log.frames(name):
                skipped += not scene.frame(frame, log.mesh(name, frame.epoch))
                done += 1
                progress(done)
    for number, name in enumerate(sorted(log.objects)):
        scene.steps(name, log.scalars(name), step_time=number == 0)
    if skipped:
        say(f"{log.path}: {skipped} frames with NaN or infinite positions are not shown")
    recording.send_blueprint(scene.blueprint())


def save_rrd(log: Log, to: Path, coloring: Coloring) -> None:
    """Writes the log as a file of the rerun viewer. Raises ClientError.

    The file is written here, at once: where rerun writes it and the disk is full, it ends with a short file, or never.
    """
    recording = _recording()
    import rerun as rr

    stream = rr.binary_stream(recording)
    try:
        with written_whole(to) as part:
            part.touch()  # a bad path is told before the work
            show_log(log, recording, coloring)
            part.write_bytes(stream.read() or b"")
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None
    finally:
        recording.disconnect()


def save_screenshot(log: Log, to: Path, coloring: Coloring) -> None:
    """Writes a picture of the last frame: from the viewer, or by matplotlib where it cannot run.

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
        from clients.picture import draw

        picture = draw(log, coloring, color_limit(log, coloring))
    picture = encoded(picture, kind)
    try:
        with written_whole(to) as part:
            part.write_bytes(picture)
    except OSError as error:
        raise ClientError(f"{to}: cannot be written: {error.strerror or error}") from None


def view_log(log: Log, coloring: Coloring, web: bool) -> None:
    """Shows the log until the viewer is closed."""
    with _viewer(web) as viewer, _sent_to(viewer) as recording:
        show_log(log, recording, coloring)
        recording.flush()
        viewer.wait()


def view_live(client: Client, coloring: Coloring, web: bool) -> None:
    """Shows what the server does now until the viewer is closed."""
    from clients.rerun_scene import RerunScene

    with _viewer(web) as viewer, _sent_to(viewer) as recording:
        _follow(client, RerunScene(recording, coloring, grow=True), viewer, recording)


def _follow(client: Client, scene: RerunScene, viewer: Viewer, recording: rr.RecordingStream) -> None:
    meshes = client.meshes()
    states, steps = client.states(), client.steps()
    first = min(meshes, default="")
    laid_out = False
    while viewer.running():
        frames = states.newest()
        for frame in frames:
            mesh = meshes.get(frame.object)
            if mesh is None or mesh.epoch != frame.epoch:  # cut since
                meshes = client.meshes()
                mesh = meshes.get(frame.object)
            if mesh and mesh.epoch == frame.epoch and len(mesh.rest) == len(frame.x):
                scene.frame(frame, mesh)
        by_object: dict[str, list[tuple]] = {}
        for step in steps.new():
            by_object.setdefault(step.header.object, []).append(row(step))
        for name, rows in by_object.items():
            scene.steps(name, columns(rows), step_time=name == first)
        if frames and not laid_out:
            recording.send_blueprint(scene.blueprint())
            laid_out = True
        time.sleep(LIVE_SECONDS)


def _viewer(web: bool) -> Viewer:
    if not web and not has_display():
        web = True
        say("no display here, so the viewer is served as a page")
    viewer = Viewer(web)
    if viewer.page:
        say(f"open {viewer.page} in a browser on this machine; Ctrl-C ends the viewer")
    return viewer


@contextmanager
def _sent_to(viewer: Viewer) -> Iterator[rr.RecordingStream]:
    """A recording that ends before its viewer does, so that it does not complain of a lost connection."""
    recording = _recording()
    recording.connect_grpc(viewer.url)
    try:
        yield recording
    finally:
        recording.disconnect()


def _recording() -> rr.RecordingStream:
    os.environ.setdefault("RUST_LOG", "error")  # rerun reads it when imported, and warns of much that we handle
    try:
        import rerun as rr
    except ImportError:
        raise ClientError(f"rerun-sdk is not installed: {to_install('view')}") from None
    return rr.RecordingStream("warpfactor")
