# SPDX-License-Identifier: MIT
"""Energies and runaways of a real server: status and watch, log, export, replay."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.system.server_process import Stage, beam, run, until
from tests.system.test_replay_of_a_server import replayed

pytestmark = pytest.mark.system

STEPS = 160
SOFT = """
dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[integrator]
scheme = "quasi_static"
[solver]
preconditioner = "block_jacobi"
projection = "clamp"
max_iterations = 5000
[[object]]
name = "soft"
mesh = { bar = [6, 2, 2], size = [3, 0.5, 0.5], split = "kuhn" }
[object.effects]
stable_neo_hookean = { young = 1.4e5, poisson = 0.4 }
fixed = { where = "X < 0.01" }
touch = true
[[object]]
name = "stiff"
mesh = { bar = [4, 1, 1], size = [3, 0.5, 0.5], split = "kuhn" }
[object.effects]
corotational = { young = 1e6, poisson = 0.4 }
fixed = { where = "X < 0.01" }
"""


def exported(log: Path, name: str) -> dict[str, np.ndarray]:
    to = log.with_suffix(f".{name}.npz")
    done = run("clients", "export", str(log), "--object", name, "--to", str(to))
    assert done.returncode == 0, done.stderr
    return dict(np.load(to))


def test_the_log_and_the_status_tell_energies(tmp_path):
    stage, log, scene = Stage(tmp_path), tmp_path / "run.mcap", beam(tmp_path, (2, 2, 5))
    try:
        server = stage.server(scene, "--device", "cpu", "--steps", str(STEPS), "--record", str(log))
        with stage.client() as client:
            client.push("beam", at=(0.5, 0.5, 4), force=(200, 0, 0), duration=0.4)
            until(lambda: client.status().objects[0].HasField("total_energy"), "the energy is in the status")
            client.pause()  # it may take longer to look than the run
            watched = run("clients", "watch", "--connect", stage.endpoint, "--count", "1")
            client.resume()
        assert watched.returncode == 0 and "energy [J]" in watched.stdout, watched.stdout + watched.stderr
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    found = exported(log, "beam")
    step, kinetic = found["scalars/step"], found["scalars/kinetic_energy"]
    mass = Simulation.load(scene).world.mass
    speeds = {int(s): 0.5 * float(mass @ (v**2).sum(axis=1)) for s, v in zip(found["step"], found["v"], strict=True)}
    kept = [k for k, s in enumerate(step) if int(s) in speeds]
    assert len(step) == STEPS and len(kept) > STEPS // 2
    np.testing.assert_allclose(kinetic[kept], [speeds[int(step[k])] for k in kept], rtol=1e-9, atol=1e-12)
    elastic, dissipated = found["scalars/elastic_energy"], found["scalars/dissipated"]
    known = np.isfinite(elastic)
    assert known[step % 20 == 0].all() and known.sum() < STEPS / 2
    start = found["x"][0]
    fallen = -9.81 * float(mass @ (found["x"][-1] - start)[:, 1])
    energy = kinetic + elastic + found["scalars/gravity_energy"]
    work = found["scalars/work"]
    assert work[-1] > 0.1 and fallen > 100
    before = 9.81 * float(mass @ start[:, 1])
    np.testing.assert_allclose((before + work - energy)[known], dissipated[known], atol=1e-6 * fallen)
    assert (np.diff(dissipated[known]) > 0).all()
    assert replayed(log, 0)["same"]


@pytest.mark.parametrize("choice", ["freeze", "go_on"])
def test_a_runaway_is_told_once_and_is_in_the_log(tmp_path, choice):
    scene, log = tmp_path / "soft.toml", tmp_path / "run.mcap"
    scene.write_text(SOFT)
    options = ["--device", "cpu", "--steps", "30", "--free-run", "--set", f"solver.on_runaway={choice}"]
    ended = run("sim_server", str(scene), "--listen", Stage(tmp_path).endpoint, "--record", str(log), *options)
    assert ended.returncode == 0, ended.stderr
    said = ended.stdout + ended.stderr
    assert said.count("runaway: ") == 1 and "object 'soft', step " in said and "run away: soft" in said
    assert ("it is frozen where the step began" in said) == (choice == "freeze")
    soft, stiff = exported(log, "soft"), exported(log, "stiff")
    away = soft["scalars/status"] == "runaway"  # not in the first step, which is as long as three bodies
    first = int(away.argmax())
    assert away.any() and first > 0 and (stiff["scalars/status"] == "converged").all()
    assert away[first:].all() or choice == "go_on"
    same = [np.array_equal(x, soft["x"][first]) for x in soft["x"][first:]]
    assert all(same) == (choice == "freeze")
    if choice == "freeze":
        assert not soft["scalars/iterations"][first + 1 :].any()
        found = replayed(log, 0)
        assert found["same"] and found["steps"] == 30


def test_what_is_frozen_takes_no_hands(tmp_path):
    stage, scene = Stage(tmp_path), tmp_path / "soft.toml"
    scene.write_text(SOFT)
    try:
        stage.server(scene, "--device", "cpu")
        with stage.client() as client:
            until(lambda: client.status().objects[0].runaway_steps, "it has run away")
            refused = ["--connect", stage.endpoint, "--object", "soft", "--at", "3", "0", "0", "--force", "0", "1", "0"]
            answer = run("clients", "push", *refused)
            assert answer.returncode != 0 and "has run away and is frozen" in answer.stderr, answer.stderr
            watched = run("clients", "watch", "--connect", stage.endpoint, "--count", "1")
            assert "RUNAWAY" in watched.stdout
    finally:
        stage.close()
