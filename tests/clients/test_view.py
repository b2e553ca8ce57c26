# SPDX-License-Identifier: MIT
"""What the viewer gets, value by value, and pictures where the machine can draw them."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
import weakref
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.frames import mesh_of
from clients.log.reader import Log
from clients.log.scalars import columns, row
from clients.viewer import view
from clients.viewer.colors import colors
from clients.viewer.screenshot import has_vulkan_driver
from clients.viewer.surface import Surface
from sim_server.recording.recorder import Recorder
from tests.clients.fake_server import FakeServer
from tests.sample_run import (
    DT,
    REST,
    TRIANGLES,
    object_step,
    positions,
    record,
    scene,
    state,
    topology,
    velocities,
)

STEPS = 6


@pytest.fixture
def log(tmp_path: Path):
    with Log(record(tmp_path / "run.mcap", STEPS, ("beam", "left leg"))) as opened:
        yield opened


class Rrd:
    """Rows of a saved recording: column values by entity, in the order of the step timeline."""

    def __init__(self, path: Path) -> None:
        chunk = pytest.importorskip("rerun.chunk")
        self._chunks = list(chunk.RrdReader(path).stream())
        self.blueprints = len(chunk.RrdReader(path).blueprints())
        self.timelines = {name for c in self._chunks for name in c.timeline_names}

    def column(self, entity: str, ending: str) -> list[tuple[int, float, np.ndarray]]:
        """(step, time [s], values) of every row that has the component."""
        rows = []
        for chunk in self._chunks:
            if chunk.entity_path != entity:
                continue
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if name.endswith(ending)]
            for name in names:
                for step, at, values in zip(batch["step"], batch["time"], batch[name], strict=True):
                    if values.is_valid:
                        rows.append((step.as_py(), at.value / 1e9, np.array(values.as_py())))
        return sorted(rows, key=lambda row: row[0])


def test_rrd_holds_every_frame_exactly(log: Log, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    view.save_rrd(log, tmp_path / "run.rrd", "displacement")
    rrd = Rrd(tmp_path / "run.rrd")
    assert rrd.timelines >= {"step", "time"} and rrd.blueprints == 1
    for entity in ("/world/beam", "/world/left\\ leg"):
        found = rrd.column(entity, "vertex_positions")
        assert [step for step, _, _ in found] == list(range(STEPS + 1))
        for step, at, values in found:
            assert at == pytest.approx(step * DT, abs=1e-9)
            np.testing.assert_array_equal(values, positions(step).astype(np.float32))
        triangles = rrd.column(entity, "triangle_indices")
        assert len(triangles) == 1 and triangles[0][0] == 0
        np.testing.assert_array_equal(triangles[0][2], TRIANGLES)
        assert len(rrd.column(entity, "vertex_colors")) == STEPS + 1


def test_rrd_curves(log: Log, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    view.save_rrd(log, tmp_path / "run.rrd", "von_mises")
    rrd = Rrd(tmp_path / "run.rrd")
    steps = [object_step("beam", step) for step in range(1, STEPS + 1)]

    def curve(quantity: str) -> list[tuple[int, float]]:
        return [(step, float(values[0])) for step, _, values in rrd.column(f"/plots/{quantity}", "scalars")]

    assert curve("iterations/beam") == [(s.step, s.iterations) for s in steps]
    assert curve("residual/beam") == [(s.step, pytest.approx(np.log10(s.residual))) for s in steps]
    assert curve("factor_age/beam") == [(s.step, 2) for s in steps if s.factor_age >= 0]
    assert curve("step_time/all") == [(s.step, 4.0) for s in steps]
    assert curve("energy/kinetic/beam") == [(s.step, 10.0 * s.step) for s in steps[1:]]
    assert curve("energy/elastic/beam") == [(s.step, 3.0 + s.step) for s in steps if s.step % 3 == 0]
    assert curve("energy/dissipated/beam") == [(s.step, 0.25 * s.step) for s in steps if s.step % 3 == 0]
    told = [(step, values) for step, _, (values,) in rrd.column("/events/beam", "text")]
    assert told == [(4, "max_iterations"), (5, "converged again")]
    assert len(curve("energy/work/beam")) == len(curve("energy/gravity/beam")) == len(steps) - 1


def test_readings_have_a_plot_of_each_quantity(tmp_path: Path) -> None:
    rr = pytest.importorskip("rerun")
    from clients.viewer.rerun_scene import RerunScene

    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "run.rrd")
    steps = [object_step("beam", step) for step in (1, 2, 3)]
    for step in steps[1:]:
        step.readings.add(of="cavity[1]", quantity="pressure", unit="Pa", value=5.0 * step.step)
    scene = RerunScene(recording, "displacement")
    scene.steps("beam", columns(map(row, steps)), step_time=False)
    assert scene.quantities == 1
    recording.flush()
    recording.disconnect()
    found = Rrd(tmp_path / "run.rrd").column("/plots/reading/pressure/cavity\\[1\\]\\ of\\ beam", "scalars")
    assert [(step, float(values[0])) for step, _, values in found] == [(2, 10.0), (3, 15.0)]


def test_a_scene_holds_the_surface_of_the_newest_mesh_alone() -> None:
    rr = pytest.importorskip("rerun")
    from clients.viewer.rerun_scene import RerunScene

    scene, mesh = RerunScene(rr.RecordingStream("test"), "displacement"), mesh_of(topology("beam"))
    first = weakref.ref(scene.surface(mesh))
    assert scene.surface(mesh) is first()
    scene.surface(replace(mesh, epoch=2))
    assert first() is None


def test_colors_have_one_scale_for_the_run(log: Log) -> None:
    """The farthest point of the last frame, x = 1 stretched by 6 %, is the end of the scale."""
    assert view.color_limit(log, "displacement") == pytest.approx(0.01 * STEPS)
    assert view.color_limit(log, "von_mises") == pytest.approx(2 * 4e4 * 0.01 * STEPS)


def test_color_map_is_viridis() -> None:
    colormaps = pytest.importorskip("matplotlib").colormaps
    values = np.linspace(0, 3, 400)
    difference = colors(values, 3.0).astype(float) - 255 * colormaps["viridis"](values / 3)
    assert np.abs(difference).max() < 4
    np.testing.assert_array_equal(colors(np.array([-1.0, 9.0, np.nan]), 3.0)[:, 0], [68, 253, 128])
    np.testing.assert_array_equal(colors(np.array([0.0, 1.0]), 0.0)[:, 0], [68, 68])


def test_surface_of_a_mesh_with_inner_nodes() -> None:
    """Node 0 is not on the surface: it is left out, and the triangles count without it."""
    rest = np.vstack([[[0.1, 0.1, 0.1]], REST[:4]])
    message = topology("beam", rest=rest, tets=np.array([[1, 2, 3, 4]]))
    message.triangles = np.array([[1, 3, 2], [1, 2, 4], [1, 4, 3], [2, 3, 4]], np.int32).tobytes()
    surface = Surface(mesh_of(message), "displacement")
    np.testing.assert_array_equal(surface.nodes, [1, 2, 3, 4])
    np.testing.assert_array_equal(surface.triangles, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    np.testing.assert_array_equal(surface.values(rest + np.array([0, 0, 2])), [2, 2, 2, 2])
    normals = surface.normals(surface.points(rest))
    np.testing.assert_allclose(normals[0], -np.ones(3) / np.sqrt(3), rtol=1e-6)  # corner of three equal faces


def test_a_new_mesh_is_sent_when_the_epoch_changes(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    more = np.vstack([REST, [[2, 2, 2]]])
    cut = topology("beam", 2, more)
    cut.triangles = np.vstack([TRIANGLES, [[3, 4, 5]]]).astype(np.int32).tobytes()
    with Recorder(tmp_path / "cut.mcap") as recorder:
        recorder.topology(topology("beam"))
        recorder.state(state("beam", 0))
        recorder.topology(cut)
        recorder.state(state("beam", 1, 2, more))
        recorder.state(state("beam", 2, 2, more))
    with Log(tmp_path / "cut.mcap") as log:
        view.save_rrd(log, tmp_path / "cut.rrd", "displacement")
    rrd = Rrd(tmp_path / "cut.rrd")
    assert [(step, len(v)) for step, _, v in rrd.column("/world/beam", "vertex_positions")] == [(0, 5), (1, 6), (2, 6)]
    assert [(step, len(v)) for step, _, v in rrd.column("/world/beam", "triangle_indices")] == [(0, 6), (1, 7)]


def test_a_run_that_blew_up_is_shown_as_far_as_it_goes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("rerun")
    with Recorder(tmp_path / "bad.mcap") as recorder:
        recorder.topology(topology("beam"))
        for step in range(4):
            message = state("beam", step)
            if step == 3:
                message.x = np.full_like(REST, np.nan).tobytes()
            recorder.state(message)
    with Log(tmp_path / "bad.mcap") as log:
        view.save_rrd(log, tmp_path / "bad.rrd", "displacement")
    assert len(Rrd(tmp_path / "bad.rrd").column("/world/beam", "vertex_positions")) == 3
    assert "1 frames with NaN" in capsys.readouterr().err


def test_unwritable_rrd(log: Log, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    with pytest.raises(ClientError, match="cannot be written: No such file"):
        view.save_rrd(log, tmp_path / "missing" / "run.rrd", "displacement")


def picture_of(path: Path) -> np.ndarray:
    image = pytest.importorskip("PIL.Image")
    return np.asarray(image.open(BytesIO(path.read_bytes())).convert("RGB")).astype(int)


def record_bent(path: Path) -> Path:
    """One big bright body: at the last frame everything has moved by the same way, the top of the scale: yellow."""
    with Recorder(path) as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(topology("beam"))
        for step in range(3):
            message = state("beam", step)
            message.x = (REST + np.array([0, 0.1 * step, 0])).tobytes()
            message.v = velocities(step).tobytes()
            recorder.state(message)
            recorder.step(object_step("beam", step + 1))
    return path


def yellow(picture: np.ndarray) -> int:
    """Pixels of the yellow end of viridis, in any light."""
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    return int(((red > 60) & (green > 0.75 * red) & (blue < 0.35 * red)).sum())


def test_picture_without_vulkan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(view, "has_vulkan_driver", lambda: False)
    with Log(record_bent(tmp_path / "run.mcap")) as log:
        view.save_screenshot(log, tmp_path / "run.png", "displacement")
    found = picture_of(tmp_path / "run.png")
    assert found.shape == (800, 1280, 3)
    assert yellow(found) > 10_000
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "begins"), [("a.png", b"\x89PNG"), ("b.JPG", b"\xff\xd8\xff"), ("c.jpeg", b"\xff\xd8\xff")]
)
def test_the_suffix_says_what_the_file_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, begins: bytes
) -> None:
    image = pytest.importorskip("PIL.Image")
    file = BytesIO()
    image.new("RGBA", (40, 30), (200, 30, 60, 255)).save(file, "PNG")
    monkeypatch.setattr(view, "has_vulkan_driver", lambda: False)
    monkeypatch.setattr("clients.viewer.snapshot_plot.draw", lambda *_: file.getvalue())
    with Log(record_bent(tmp_path / "run.mcap")) as log:
        view.save_screenshot(log, tmp_path / name, "displacement")
    assert (tmp_path / name).read_bytes().startswith(begins)
    with image.open(tmp_path / name) as picture:
        assert np.abs(np.asarray(picture.convert("RGB"), int) - [200, 30, 60]).max() <= 3


@pytest.mark.parametrize("name", ["run.gif", "run", "run.png.gz"])
def test_other_suffixes_are_refused_before_anything_is_drawn(tmp_path: Path, name: str) -> None:
    with (
        Log(record_bent(tmp_path / "run.mcap")) as log,
        pytest.raises(BadInput, match=r"--screenshot .*: the suffix is '.*'; allowed are .png, .jpg, .jpeg"),
    ):
        view.save_screenshot(log, tmp_path / name, "displacement")
    assert not (tmp_path / name).exists()


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.skipif(not has_vulkan_driver(), reason="no Vulkan driver (mesa-vulkan-drivers)")
def test_screenshot_of_the_viewer(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("rerun")
    with Log(record_bent(tmp_path / "run.mcap")) as log:
        view.save_screenshot(log, tmp_path / "run.png", "displacement")
    assert "matplotlib" not in capsys.readouterr().err
    found = picture_of(tmp_path / "run.png")
    assert found.shape == (800, 1280, 3)
    assert yellow(found) > 2_000


def test_no_frames_no_picture(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.step(object_step("beam", 1))
    with Log(tmp_path / "run.mcap") as log, pytest.raises(BadInput, match="no frames were recorded"):
        view.save_screenshot(log, tmp_path / "run.png", "displacement")


class _Switch:
    """Stands for a viewer that is closed at some time."""

    def __init__(self, seconds: float) -> None:
        self._end = time.monotonic() + seconds

    def running(self) -> bool:
        return time.monotonic() < self._end


@pytest.mark.system
def test_live_frames_and_curves(tmp_path: Path) -> None:
    """What a running server publishes ends up in the recording, with colours that grow with the data."""
    rr = pytest.importorskip("rerun")
    from clients.viewer.rerun_scene import RerunScene

    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "live.rrd")
    obstacles = ("floor", "tool")
    with FakeServer(objects=("beam",), obstacles=obstacles) as server, Client(connect=[server.endpoint]) as client:
        done = threading.Event()

        def publish() -> None:
            step = 0
            while not done.wait(0.05):
                server.publish(step := step + 1)

        publisher = threading.Thread(target=publish)
        publisher.start()
        try:
            scene = RerunScene(recording, "displacement", grow=True)
            view.follow(client, scene, _Switch(2.0), recording)  # type: ignore[arg-type]
        finally:
            done.set()
            publisher.join()
    recording.flush()
    recording.disconnect()
    rrd = Rrd(tmp_path / "live.rrd")
    frames = rrd.column("/world/beam", "vertex_positions")
    assert frames and rrd.blueprints == 1
    for step, _, values in frames:
        np.testing.assert_array_equal(values, positions(step).astype(np.float32))
    assert len(rrd.column("/plots/iterations/beam", "scalars")) >= len(frames)
    assert len(rrd.column("/world/beam", "triangle_indices")) == 1
    poses = rrd.column("/world/tool", ":translation")
    assert len(poses) > 2 and all(at[0][1] == -1 + step / 8 for step, _, at in poses), "and at step 0 the start"


@pytest.mark.slow
@pytest.mark.system
def test_viewer_process_is_local_and_ends(tmp_path: Path) -> None:
    """The page is served on loopback alone, and Ctrl-C leaves no process behind."""
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("rerun")
    log = record(tmp_path / "run.mcap", 5)
    command = [sys.executable, "-m", "clients", "view", str(log), "--web"]
    process = subprocess.Popen(command, cwd=Path(__file__).parents[2], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        while (line := process.stderr.readline()) and "open http://127.0.0.1:" not in line:
            pass
        assert "in a browser on this machine" in line
        children = psutil.Process(process.pid).children(recursive=True)
        assert children
        ports = [c.laddr for child in children for c in child.net_connections("tcp") if c.status == "LISTEN"]
        assert ports and {address.ip for address in ports} == {"127.0.0.1"}
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    finally:
        process.kill()
        process.stderr.close()
        process.wait()
    assert psutil.wait_procs(children, timeout=30)[1] == []
