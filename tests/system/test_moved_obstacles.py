# SPDX-License-Identifier: MIT
"""A tool that a client moves at 1 kHz into a body, with real processes: logged, and repeated bit for bit."""

import time
from pathlib import Path

import numpy as np
import pytest

from clients.client import Client
from clients.errors import BadInput
from clients.log.reader import Log
from protocol import messages_pb2 as pb
from tests.contact_scene import DT
from tests.ports import free_endpoint
from tests.system.server_process import Stage, fresh, run, until
from tests.system.test_replay_of_a_server import CPU, copied, replayed
from tests.system.test_replay_of_a_server import messages as logged

pytestmark = pytest.mark.system

STEPS = 400
SCENE = f"""
dt = {DT}
[effects]
gravity = {{ g = [0, -9.81, 0] }}
contact = true
[solver]
preconditioner = "cholesky"
[[object]]
name = "cube"
mesh = {{ bar = [3, 3, 3], size = [0.3, 0.3, 0.3], split = "kuhn" }}
[object.effects]
corotational = {{ young = 1e5, poisson = 0.3 }}
touch = true
[[obstacle]]
name = "floor"
shape = "plane"
[[obstacle]]
name = "tool"
shape = "sphere"
radius = 0.1
pose = {{ translate = [0.15, 0.45, 0.15] }}
moved = "client"
max_speed = 0.4
"""


def press(client: Client) -> None:
    """Sends the tool into the cube about 1000 times a second and lifts it, last in a pause; a push in between."""
    tool = client.obstacle("tool")
    for k in range(300):
        tool.move((0.15, 0.45 - 0.0004 * k, 0.15))
        time.sleep(0.001)
        if k == 150:
            client.push("cube", at="top", force=(0.5, 0, 0), duration=0.1)
    tool.move((0.1, 0.45, 0.15), rotation=(0.8, 0, 0.6, 0), wait=True)
    client.pause()
    for k in range(5):
        tool.move((0.1 + 0.01 * k, 0.45, 0.15), wait=True)
    client.resume()


def recorded(folder: Path, scene: str) -> Path:
    """Returns the log of a run with a worker and a client that presses."""
    stage, log = Stage(folder), folder / "run.mcap"
    (folder / "contact.toml").write_text(scene)
    try:
        server = stage.server(
            folder / "contact.toml", "--steps", str(STEPS), "--record", str(log), "--workers", "1", *CPU
        )
        with stage.client() as client:
            until(lambda: client.status().step > 2, "the simulation runs")
            press(client)
            status = fresh(client)
            assert [o.header.object for o in status.obstacles] == ["floor", "tool"]
            with pytest.raises(BadInput, match="obstacle 'floor' is not moved by clients"):
                client.obstacle("floor").move((0, 1, 0), wait=True)
        assert server.wait() == 0, server.output()
        assert status.moves_replaced > 0 and status.commands_refused == 0
    finally:
        stage.close()
    return log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("contact"), SCENE)


def test_the_same_bit_for_bit(log: Path) -> None:
    found = replayed(log, 0)
    assert found["same"] and found["first"] is None and not found["notes"]
    with Log(log) as opened:
        frames = sum(1 for _ in opened.frames("cube"))  # a busy machine may leave some out
    assert (found["steps"], found["frames"]) == (STEPS, frames) and frames > STEPS / 2


@pytest.mark.parametrize("scheme", ["ros2", "bdf2"])
def test_the_same_bit_for_bit_with_other_schemes(scheme: str, tmp_path: Path) -> None:
    """The cube falls by its own scheme, and lies by backward Euler."""
    scene = SCENE.replace("contact = true", 'contact = true\n[integrator]\nscheme = "' + scheme + '"')
    raised = scene.replace('split = "kuhn" }', 'split = "kuhn" }\npose = { translate = [0, 0.03, 0] }')
    assert raised != scene
    log = recorded(tmp_path, raised)
    found = replayed(log, 0)
    assert found["same"] and found["first"] is None and not found["notes"]
    forms = [step.form for step in logged(log, "step")]
    assert forms[0] != pb.EULER and forms[-1] == pb.EULER


@pytest.mark.parametrize(
    ("update", "scheme"),
    [
        ("every-7", "ros2"), ("lockstep-3", "backward_euler"), ("lockstep-3", "newmark"), ("never", "backward_euler"),
    ],
)  # fmt: skip
def test_the_same_whatever_the_policy(tmp_path: Path, update: str, scheme: str) -> None:
    """As fast as it goes, the cube lands while a paddle on keyframes comes up to it."""
    log, scene = tmp_path / "run.mcap", tmp_path / "contact.toml"
    paddle = (
        "{ time = 0, translate = [0.6, 0.2, 0.15] }, { time = 0.5, translate = [0.33, 0.2, 0.15], rotate = [0, 20, 0] }"
    )
    box = f'[[obstacle]]\nname = "paddle"\nshape = "box"\nsize = [0.1, 0.4, 0.4]\nkeyframes = [{paddle}]\n'
    scene.write_text(SCENE.replace("moved", "# moved").replace("max_speed", "# max_speed") + box)
    options = ("--free-run", "--steps", "60", "--record", str(log), "--set", f"solver.update={update}")
    options += ("--set", f"integrator.scheme={scheme}", *CPU)
    result = run("sim_server", str(scene), *options, "--listen", free_endpoint())
    assert result.returncode == 0, result.stdout + result.stderr
    assert replayed(log, 0)["same"] and not logged(log, "targets")
    touched = {r.obstacle for step in logged(log, "step") for r in step.reactions}
    x = [pose.position.x for pose in logged(log, "pose")]
    np.testing.assert_allclose(x, np.linspace(0.6, 0.33, 51).tolist() + 10 * [0.33], atol=1e-12)
    assert touched == {"floor", "paddle"} and len({s.factor_step for s in logged(log, "step")}) > (update != "never")


def test_without_one_of_the_targets_it_diverges(log: Path, tmp_path: Path) -> None:
    targets = logged(log, "targets")
    steps = [t.step for t in targets]
    assert len(steps) > 20 and steps == sorted(set(steps))
    pressed = next(s.step for s in logged(log, "step") if any(r.obstacle == "tool" for r in s.reactions))
    changed = copied(log, tmp_path / "changed.mcap", {"targets": lambda m: m.step > pressed + 20})
    found = replayed(changed, 1)
    assert not found["same"] and found["first"]["step"] <= pressed + 20


def test_the_log_tells_poses_contacts_and_reactions(log: Path, tmp_path: Path) -> None:
    with Log(log) as opened:
        assert opened.notes == [] and set(opened.obstacles) == {"floor", "tool"}
        assert opened.obstacles["tool"].moved == "client" and opened.obstacles["tool"].size == (0.1,)
        poses, frames = opened.poses["tool"], [frame.step for frame in opened.frames("cube")]
        assert [pose.step for pose in poses] == frames and set(opened.poses) == {"tool"}
        assert frames[0] == 0 and frames[-1] == STEPS and len(frames) > STEPS / 2, "a busy machine may leave some out"
        height = np.array([pose.pose.position[1] for pose in poses])
        assert np.abs(np.diff(height) / np.diff(frames)).max() <= 0.4 * DT * 1.001, (
            "no faster than max_speed: each pose is of its frame's step"
        )
        assert height.min() < 0.4
        scalars = opened.scalars("cube")
    assert scalars["contacts"].max() > 16 and (scalars["reaction/tool/force_y"] > 0).any()
    out = tmp_path / "cube.csv"
    assert run("clients", "export", str(log), "--object", "cube", "--to", str(out)).returncode == 0
    assert "reaction/tool/force_y" in out.read_text().splitlines()[0]


def test_forces_of_each_step_come_to_a_client(tmp_path: Path) -> None:
    """The cube rests on the floor; no step is left out, and what they hold is what the log says."""
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    (tmp_path / "contact.toml").write_text(SCENE)
    found: list[pb.ObjectStep] = []
    try:
        server = stage.server(tmp_path / "contact.toml", "--steps", "300", "--record", str(log), *CPU)
        with stage.client() as client:
            reactions = client.reactions()
            until(lambda: found.extend(reactions.new()) or (found and found[-1].step > found[0].step + 50), "steps")
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    assert [step.step for step in found] == list(range(found[0].step, found[-1].step + 1))
    steps = {step.step: step for step in logged(log, "step")}
    for step in found:
        told = steps[step.step]
        assert (step.header.object, step.time, step.contacts) == ("cube", told.time, told.contacts)
        assert list(step.reactions) == list(told.reactions) and not step.iterations
    assert found[-1].reactions[0].obstacle == "floor" and found[-1].reactions[0].force.y < -100


def test_a_live_viewer_gets_obstacles_and_poses(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    (tmp_path / "contact.toml").write_text(SCENE)
    try:
        stage.server(tmp_path / "contact.toml", *CPU)
        with stage.client() as client:
            assert client.obstacles()["floor"].shape == "plane"
            poses, found = client.poses(), []
            client.obstacle("tool").move((0.15, 0.8, 0.15), wait=True)
            until(lambda: found.extend(poses.newest()) or any(f.pose.position[1] == 0.8 for f in found), "it is there")
            assert {f.obstacle for f in found} == {"tool"} and found[0].step < found[-1].step
            client.stop()
    finally:
        stage.close()
