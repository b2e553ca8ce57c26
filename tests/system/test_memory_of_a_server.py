# SPDX-License-Identifier: MIT
"""A server whose bodies remember: pulled, put back, saved, resumed; its logs are repeated to the bit."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from clients.__main__ import app
from tests.system.server_process import Stage, fresh, run, until

pytestmark = pytest.mark.system

HEAD = """
dt = 0.01
[effects]
gravity = true
contact = true
[integrator]
linearizations = 4
[solver]
preconditioner = "block_jacobi"
[[obstacle]]
name = "floor"
shape = "plane"
pose = { translate = [0, -0.1, 0] }
"""
OBJECT = """
[[object]]
name = "NAME"
mesh = { bar = [4, 2, 2], size = [0.4, 0.1, 0.1] }
pose = { translate = [0, 0, PLACE] }
[object.effects]
corotational = { young = 1e6, poisson = 0.3 }
fixed = { where = "X < 0.01" }
touch = true
"""
MEMORIES = {
    "viscous": "prony = { terms = [{ g = 0.5, tau = 0.1 }, { g = 0.2, tau = 1 }] }",
    "plastic": "plasticity = { yield_stress = 1e4, hardening = 1e5 }",
    "torn": "damage = { strength = 1e4, fracture_energy = 500 }",
}


def test_what_bodies_remember_is_put_back_saved_and_replayed_to_the_bit(tmp_path: Path) -> None:
    scene, log, later, file = (tmp_path / name for name in ("scene.toml", "run.mcap", "later.mcap", "saved.npz"))
    objects = [OBJECT.replace("NAME", n).replace("PLACE", f"{0.12 * k}") for k, n in enumerate(MEMORIES)]
    scene.write_text(HEAD + "".join(o + m + "\n" for o, m in zip(objects, MEMORIES.values(), strict=True)))
    stage = Stage(tmp_path)
    try:
        server = stage.server(scene, "--record", str(log))
        with stage.client() as client:
            for name in MEMORIES:
                client.grab(name, at="tip", target=(0.4, 0.1, 0.2), stiffness=1e3, max_force=50)
            until(lambda: fresh(client).step > 20, "they are pulled")
            step = client.reset("plastic").status.step
            until(lambda: fresh(client).step > step + 10, "they go on")
            client.set("viscous.corotational.young", 2e6)
            client.pause()
            client.step(3)
            said = CliRunner().invoke(app, ["save", str(file), "--connect", stage.endpoint]).output
            assert said.startswith("saved at step ")
            client.stop()
        assert server.wait() == 0, server.output()
        server = stage.server(scene, "--resume", str(file), "--record", str(later), "--steps", "30", "--free-run")
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    for each in (log, later):
        done = run("clients", "replay", str(each), "--simulate")
        assert done.returncode == 0 and "the same bit for bit" in done.stdout, done.stdout + done.stderr
