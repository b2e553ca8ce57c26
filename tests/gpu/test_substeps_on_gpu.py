# SPDX-License-Identifier: MIT
"""Explicit substeps on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.holders.holder_scenes import held_bar, left
from tests.scenes import bar, scene
from tests.system.test_replay_of_a_server import messages, recorded, replayed

pytestmark = pytest.mark.gpu

EXPLICIT = {"scheme": "central_difference"}
LAWS: dict[str, dict[str, Any]] = {
    "corotational": {"young": 1e5, "poisson": 0.4}, "stable_neo_hookean": {"young": 1e5, "poisson": 0.45},
    "mass_spring": {"young": 1e5},
}  # fmt: skip


def both(*objects: dict, **table: Any) -> tuple[Simulation, Simulation]:
    made = [scene(*objects, integrator=EXPLICIT, gravity=(0, -9.81, 0), **table) for _ in range(2)]
    return Simulation(made[0], "gpu"), Simulation(made[1])


@pytest.mark.parametrize("law", ["corotational", "stable_neo_hookean", "mass_spring"])
@pytest.mark.parametrize("damping", [{}, {"mass": 0.5, "stiffness": 0.002}], ids=["undamped", "damped"])
def test_steps_are_those_of_the_cpu(law, damping):
    """Substeps come in fours there, so that both agree up to the error of the substep."""
    effects = {law: LAWS[law], "fixed": {"where": "X < 0.01"}} | ({"rayleigh": damping} if damping else {})
    sims = both({**bar((6, 2, 2), (3, 1, 1)), "effects": effects}, bar((2, 1, 1), name="free"), dt=0.01)
    for sim in sims:
        sim.engine.run(40)
        sim.fetch()
    (x, y), (g, c) = [s.world.x for s in sims], [s.engine.records() for s in sims]
    assert np.abs(x - y).max() < 5e-3 and not g["status"].any() and not g["iterations"].any()
    assert (g["substeps"] % 4 == 0).all() and (g["substeps"] >= c["substeps"]).all()
    np.testing.assert_allclose(g["stable_step"], c["stable_step"], rtol=0.1)


def test_same_bits_whatever_the_batches():
    ends = []
    for parts in ((40,), (1, 7, 32)):
        sim, _ = both(bar((6, 2, 2), (3, 1, 1), fixed="X < 0.01", young=1e6), dt=0.02)
        for steps in parts:
            sim.engine.run(steps)
        ends.append(sim.fetch().x.copy())
    assert (ends[0] == ends[1]).all()


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_single_precision(precision):
    body = bar((6, 2, 2), (3, 1, 1), fixed="X < 0.01", young=1e5)
    given = scene(body, integrator=EXPLICIT, gravity=(0, -9.81, 0), precision=precision)
    single, (double, _) = Simulation(given, "gpu"), both(body)
    for sim in (single, double):
        sim.engine.run(50)
        sim.fetch()
    assert np.abs(single.world.x - double.world.x).max() < 5e-3
    assert single.engine.records()["stable_step"][0] == pytest.approx(
        double.engine.records()["stable_step"][0], rel=0.1
    )


def test_a_holder_and_its_force():
    moves = [{"time": 0.0}, {"time": 0.2, "translate": [0.1, 0.2, 0]}, {"time": 0.3}]
    sims = [
        held_bar(left(keyframes=moves), device=device, integrator=EXPLICIT, damping=(1.0, 0.0), gravity=(0, -9.81, 0),
                 dt=0.005, solver={"preconditioner": "auto"})
        for device in ("gpu", "cpu")
    ]  # fmt: skip
    found = []
    for sim in sims:
        sim.engine.run(80)
        sim.fetch()
        found.append(sim.engine.records_and_reactions()[1][-20:].mean(axis=0))
    assert np.abs(sims[0].world.x - sims[1].world.x).max() < 2e-3
    assert np.abs(found[0] - found[1]).max() < 0.05 * np.abs(found[1]).max()


def test_grabs_keep_the_steps_stable():
    sim, _ = both(bar((2, 1, 1), young=1e4, fixed="X < 0.01", touch={"max_force": 1e9}))
    sim.engine.run(8)
    sim.touch.grab("me", "bar", (2, 0.5, 0.5), 0.8, (2.05, 0.5, 0.5), 1e7, 1e9, 60.0)
    sim.engine.run(60)
    records = sim.engine.records()
    assert not records["status"].any() and records["stable_step"][-1] < 0.1 * records["stable_step"][0]


def test_a_body_without_forces_goes_back_and_rests():
    body = {**bar((2, 1, 1)), "effects": {"neo_hookean": {"young": 1e5, "poisson": 0.3}}}
    sim, _ = both(body, dt=0.01)
    sim.world.x[0] = sim.world.x[1] + [1.0, 0, 0]  # turned over
    twin = sim.engine.gpu.twin(sim.world.x)
    twin.set(sim.world.x)
    start = sim.world.x.copy()
    sim.engine.run(3)
    assert (sim.engine.records()["status"] == 5).all() and (sim.fetch().x == start).all()


def test_a_run_with_pushes_and_a_grab_is_repeated(tmp_path: Path) -> None:
    explicit = '[integrator]\nscheme = "central_difference"'
    log = recorded(tmp_path, explicit, "none", "--device", "gpu", "--realtime")
    assert all(s.substeps > 0 and s.iterations == 0 for s in messages(log, "step"))
    assert replayed(log, 0)["same"]
