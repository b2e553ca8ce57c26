# SPDX-License-Identifier: MIT
"""A holder and an obstacle that a client moves, with real processes: logged, and repeated bit for bit."""

import time
from pathlib import Path

import pytest

from clients.log.reader import Log
from tests.ports import free_endpoint
from tests.system.server_process import Stage, run, until
from tests.system.test_replay_of_a_server import CPU, replayed
from tests.system.test_replay_of_a_server import messages as logged

pytestmark = pytest.mark.system

STEPS = 300
SCENE = """
dt = 0.01
[effects]
gravity = { g = [0, -9.81, 0] }
contact = true
[solver]
preconditioner = "cholesky"
[[object]]
name = "flap"
mesh = { bar = [6, 2, 3], size = [0.3, 0.1, 0.15], split = "kuhn" }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
fixed = { where = "X < 0.01" }
[[holder]]
name = "grip"
object = "flap"
where = "X > 0.29"
moved = "client"
max_speed = 0.5
[[obstacle]]
name = "tool"
shape = "sphere"
radius = 0.05
pose = { translate = [0.15, 0.2, 0.075] }
moved = "client"
"""


def test_what_a_client_did_with_a_holder_is_repeated(tmp_path: Path) -> None:
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    (tmp_path / "flap.toml").write_text(SCENE)
    try:
        server = stage.server(
            tmp_path / "flap.toml", "--steps", str(STEPS), "--record", str(log), "--workers", "1", *CPU
        )
        with stage.client() as client:
            until(lambda: client.status().step > 2, "the simulation runs")
            grip, tool = client.obstacle("grip"), client.obstacle("tool")
            start = grip.shape.start.position
            for k in range(150):
                grip.move((start[0], start[1] + 0.0004 * k, start[2]), rotation=(1, 0, 0, 0))
                tool.move((0.15, 0.2 - 0.0003 * k, 0.075))
                time.sleep(0.002)
            grip.move((start[0], start[1] + 0.1, start[2]), wait=True)
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    found = replayed(log, 0)
    assert found["same"] and found["steps"] == STEPS and not found["notes"]
    targets = logged(log, "targets")
    assert {t.obstacle for message in targets for t in message.targets} == {"grip", "tool"}
    with Log(log) as opened:
        assert opened.obstacles["grip"].shape == "holder" and set(opened.poses) == {"grip", "tool"}
        height = [pose.pose.position[1] for pose in opened.poses["grip"]]
        assert max(height) - height[0] > 0.05
        assert abs(opened.scalars("flap")["reaction/grip/force_y"]).max() > 1
    assert run("clients", "view", str(log), "--screenshot", str(tmp_path / "flap.png")).returncode == 0


@pytest.mark.parametrize("update", ["lockstep-3", "never"])
def test_keyframes_are_repeated_whatever_the_policy(tmp_path: Path, update: str) -> None:
    log = tmp_path / "run.mcap"
    options = ("--free-run", "--steps", "40", "--record", str(log), "--set", f"solver.update={update}", *CPU)
    result = run("sim_server", "deploy/scenes/needle_holder.toml", *options, "--listen", free_endpoint())
    assert result.returncode == 0, result.stdout + result.stderr
    assert replayed(log, 0)["same"]
    assert {r.obstacle for step in logged(log, "step") for r in step.reactions} == {"needle_holder"}
