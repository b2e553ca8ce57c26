# SPDX-License-Identifier: MIT
"""A scalpel that a client moves through a bar, with real processes: log, status, replay, reset."""

from pathlib import Path

import pytest

from clients.client import Client
from tests.contact_scene import DT
from tests.system.server_process import Stage, fresh, until
from tests.system.test_replay_of_a_server import CPU, replayed

pytestmark = pytest.mark.system

SCENE = f"""
dt = {DT}
[effects]
contact = {{ between = false }}
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "bar"
mesh = {{ bar = [6, 2, 2], size = [0.6, 0.2, 0.2] }}
[object.effects]
corotational = {{ young = 1e5, poisson = 0.3 }}
fixed = {{ where = "X < 0.01" }}
cutting = true
[[obstacle]]
name = "scalpel"
shape = "box"
size = [0.002, 0.1, 0.3]
edge = [[0, -0.12, -0.2], [0, -0.12, 0.2]]
pose = {{ translate = [0.34, 0.35, 0.1] }}
moved = "client"
"""


def carve(client: Client) -> list[int]:
    """Moves the blade down and up, resets and cuts again; returns how many elements were there then, and when."""
    found = []
    knife = client.obstacle("scalpel")
    until(lambda: fresh(client).step > 2, "it moves")
    for _ in range(2):
        before = fresh(client).objects[0].tets
        knife.move((0.34, 0.15, 0.1), wait=True)
        until(lambda: fresh(client).objects[0].tets < before, "it cuts")  # noqa: B023
        knife.move((0.34, 0.35, 0.1), wait=True)
        found.append(fresh(client).objects[0].tets)
        client.reset()
        until(lambda: fresh(client).objects[0].tets == before, "it is whole again")  # noqa: B023
    return found


def test_what_a_client_cuts_by_an_obstacle_is_logged_and_repeated(tmp_path: Path) -> None:
    stage, log, scene = Stage(tmp_path), tmp_path / "run.mcap", tmp_path / "carve.toml"
    scene.write_text(SCENE)
    try:
        server = stage.server(scene, "--record", str(log), *CPU)
        with stage.client() as client:
            left = carve(client)
            client.stop()
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    assert all(0 < n < 6 * 2 * 2 * 6 for n in left)
    found = replayed(log, 0)
    assert found["same"] and found["first"] is None, found
