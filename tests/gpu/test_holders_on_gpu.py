# SPDX-License-Identifier: MIT
"""Holders on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.holders.holder_scenes import held_bar, left, right
from tests.system.server_process import Stage
from tests.system.test_replay_of_a_server import replayed

pytestmark = pytest.mark.gpu

MOTION = [{"time": 0.0}, {"time": 0.2, "translate": [0.1, 0.2, 0], "rotate": [0, 40, 90]}, {"time": 0.3}]
SCHEMES: dict[str, dict[str, Any]] = {
    "backward_euler": {}, "newmark": {"scheme": "newmark"}, "bdf2": {"scheme": "bdf2"},
    "generalized_alpha": {"scheme": "generalized_alpha"}, "quasi_static": {"scheme": "quasi_static"},
}  # fmt: skip


def run(sim: Simulation, steps: int) -> tuple[np.ndarray, np.ndarray]:
    sim.engine.run(steps)
    sim.fetch()
    return sim.engine.records_and_reactions()


@pytest.mark.parametrize("touch", [False, True])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_steps_and_forces_are_those_of_the_cpu(scheme, touch):
    keys: dict[str, Any] = {"gravity": (0, -9.81, 0), "integrator": SCHEMES[scheme], "damping": (0.2, 0.01)}
    keys |= {"touch": True} if touch else {}
    sims = [held_bar(left(), right(keyframes=MOTION), device=device, **keys) for device in ("gpu", "cpu")]
    (g, on_gpu), (c, on_cpu) = (run(sim, 40) for sim in sims)
    assert np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-7
    assert np.abs(sims[0].world.v - sims[1].world.v).max() < 1e-5
    np.testing.assert_allclose(on_gpu, on_cpu, atol=1e-5 * np.abs(on_cpu).max())
    assert (g["status"] == c["status"]).all()
    np.testing.assert_allclose(g["work"], c["work"], atol=1e-6 * np.abs(c["work"]).max())


@pytest.mark.parametrize("scheme", SCHEMES)
def test_with_newton_raphson_too(scheme):
    newton = SCHEMES[scheme] | {"linearizations": 8, "tolerance": 1e-9}
    keys: dict[str, Any] = {"gravity": (0, -9.81, 0), "integrator": newton, "damping": (0.2, 0.01)}
    sims = [held_bar(left(), right(keyframes=MOTION), device=device, **keys) for device in ("gpu", "cpu")]
    (g, on_gpu), (c, on_cpu) = (run(sim, 20) for sim in sims)
    assert np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-7
    np.testing.assert_allclose(on_gpu, on_cpu, atol=1e-5 * np.abs(on_cpu).max())
    assert (g["linearizations"] == c["linearizations"]).all() and g["linearizations"].max() > 1
    np.testing.assert_allclose(g["work"], c["work"], atol=1e-6 * np.abs(c["work"]).max())


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_a_holder_at_rest_is_fixed_nodes(precision):
    solver = {"precision": precision, "tolerance": 1e-5}
    sims = [
        held_bar(*holders, gravity=(0, -9.81, 0), device="gpu", solver=solver, **fixed)
        for holders, fixed in (((), {"fixed": "X < 0.01"}), ((left(moved="client"),), {}))
    ]
    for sim in sims:
        run(sim, 30)
    np.testing.assert_allclose(sims[0].world.x, sims[1].world.x, atol=1e-6 if precision == "float64" else 1e-4)


def test_a_holder_goes_to_a_clients_pose():
    sim = held_bar(left(), right(moved="client", max_speed=0.5), device="gpu")
    run(sim, 3)
    sim.holders.move("right", (2.1, 0.5, 0.5), (1, 0, 0, 0))
    run(sim, 200)
    assert sim.world.x[sim.world.rest[:, 0] > 1.99].mean(axis=0) == pytest.approx([2.1, 0.5, 0.5], abs=1e-9)


def test_a_log_of_a_holder_is_repeated(tmp_path: Path) -> None:
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    try:
        options = ("--device", "gpu", "--free-run", "--steps", "120", "--set", "solver.update=lockstep-3")
        server = stage.server("deploy/scenes/needle_holder.toml", "--record", str(log), *options)
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    assert replayed(log, 0)["same"]
