# SPDX-License-Identifier: MIT
"""Explicit substeps: order, momenta, energy, frequencies, the stable step, holders, grabs, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import eigsh

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.hard_cases.slivers import sliver_bar
from tests.holders.holder_scenes import held_bar, left
from tests.scenes import bar, scene, simulation

EXPLICIT = {"scheme": "central_difference"}


def explicit(*objects: dict, **table: Any) -> Simulation:
    return simulation(*objects, integrator=EXPLICIT, **table)


def largest_frequency(objects: list[dict], **table: Any) -> float:
    """Largest angular frequency of all bodies, from the assembled matrix [1/s]."""
    sim = simulation(*objects, warp=False, projection="none", preconditioner="block_jacobi", **table)
    return frequency_in_matrix(sim)


def frequency_in_matrix(sim: Simulation) -> float:
    sim.engine.assemble()
    w, found = sim.world, []
    for body in w.bodies:
        mass, free = np.repeat(w.mass[body.nodes], 3), np.repeat(w.free[body.nodes], 3) > 0
        stiff = (sim.matrix(body.index) - diags_array(mass)).tocsr()[free][:, free] / w.dt**2
        scale = diags_array(1 / np.sqrt(mass[free]))
        found.append(eigsh(scale @ stiff @ scale, k=1, return_eigenvectors=False)[0])
    return float(np.sqrt(max(found)))


def test_order_two_in_the_substep() -> None:
    ends = []
    for steps in (80, 160, 1280):
        sim = explicit(bar((4, 1, 1), (2, 0.5, 0.5), young=1e4, fixed="X < 0.01"), dt=1.0 / steps, gravity=(0, 0, -9.8))
        sim.engine.run(steps)
        assert (sim.engine.records()["substeps"] == 1).all()
        ends.append(np.stack([sim.world.x, sim.world.v]))
    errors = [np.linalg.norm(end - ends[-1], axis=(1, 2)) for end in ends[:-1]]
    assert (np.abs(np.log2(errors[0] / errors[1]) - 2) < 0.1).all()


@pytest.mark.parametrize("law", ["corotational", "stable_neo_hookean"])
def test_a_free_body_keeps_its_momenta(law: str) -> None:
    sim = explicit({**bar((3, 1, 1), (2, 0.6, 0.6)), "effects": {law: {"young": 2e5, "poisson": 0.3}}}, dt=0.05)
    w = sim.world
    w.v[:] = np.cross([1.0, 2.0, 3.0], w.x) + np.random.default_rng(1).normal(0, 0.5, w.x.shape)
    momenta = [w.mass @ w.v, w.mass @ np.cross(w.x, w.v)]
    sim.engine.run(100)
    assert sim.engine.records()["substeps"].min() > 1
    assert np.allclose([w.mass @ w.v, w.mass @ np.cross(w.x, w.v)], momenta, rtol=1e-11, atol=1e-9)


def test_the_energy_of_an_undamped_bar_stays_within_bounds() -> None:
    sim = explicit(bar((4, 1, 1), (2, 0.5, 0.5), young=1e5, fixed="X < 0.01"), dt=0.005, gravity=(0, 0, -9.8))
    sim.engine.loop.energy_every = 20
    total = []
    for _ in range(10):
        sim.engine.run(1000)
        r = sim.engine.records()
        due = np.isfinite(r["elastic"])
        total.append((r["kinetic"] + r["elastic"] + r["gravity"])[due])
        assert (r["status"] == 0).all()
    swing = r["kinetic"].max()
    assert np.ptp(np.concatenate(total)) < 0.05 * swing
    assert abs(total[-1].mean() - total[0].mean()) < 1e-3 * swing


def test_a_bar_rings_with_its_frequency() -> None:
    """sqrt(E / rho) / (4 L) of a bar with one end fixed, without contraction across it."""
    sim = explicit(bar((24, 1, 1), (4, 0.2, 0.2), young=1e6, poisson=0.0, fixed="X < 0.01"), dt=0.002)
    w, speed = sim.world, np.sqrt(1e6 / 1000)
    w.x[:, 0] += 1e-4 * np.sin(np.pi * w.rest[:, 0] / 8)
    tip, moved = np.argmax(w.rest[:, 0]), []
    for _ in range(600):
        sim.engine.run(1)
        moved.append(w.x[tip, 0] - w.rest[tip, 0])
    signs = np.flatnonzero(np.diff(np.sign(moved)))
    period = 2 * 0.002 * (signs[-1] - signs[0]) / (len(signs) - 1)
    assert period == pytest.approx(16 / speed, rel=0.01)


def test_it_agrees_with_an_implicit_scheme() -> None:
    def end(integrator: dict[str, Any], dt: float) -> NDArray[np.float64]:
        body = {**bar((4, 1, 1), (2, 0.5, 0.5), fixed="X < 0.01"), "density": 1000}
        body["effects"] |= {"rayleigh": {"mass": 0.5, "stiffness": 0.01}}
        sim = simulation(body, dt=dt, gravity=(0, 0, -9.8), integrator=integrator, preconditioner="auto"
                         if integrator == EXPLICIT else "block_jacobi")  # fmt: skip
        sim.engine.run(round(0.5 / dt))
        return sim.world.x

    exact = end({"scheme": "newmark", "linearizations": 20, "tolerance": 1e-8}, 0.001)
    moved = np.abs(exact - end(EXPLICIT, 0.5)).max()
    assert np.abs(exact - end(EXPLICIT, 0.01)).max() < 5e-3
    assert np.abs(exact - end(EXPLICIT, 0.00025)).max() < 2e-4 and moved < 5e-3


SHAPES = {
    "coarse": {"cells": (2, 1, 1)},
    "fine": {"cells": (10, 3, 3)},
    "flat cells": {"cells": (8, 2, 2), "size": (1.0, 1.0, 0.05)},
    "nearly incompressible": {"cells": (5, 2, 2), "poisson": 0.49},
    "held": {"cells": (6, 2, 2), "fixed": "X < 0.01"},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_estimate_is_the_stable_step(shape: str) -> None:
    body = [bar(young=1e6, **dict(SHAPES[shape])), bar((2, 2, 2), name="soft", young=1e3)]
    sim = explicit(*body)
    sim.engine.run(1)
    records = sim.engine.records()
    exact = 2 / largest_frequency(body)
    assert 0.97 < records["stable_step"].min() / exact < 1.03
    assert sim.world.dt / records["substeps"][0] < 0.95 * exact


def test_the_stable_step_with_slivers_and_damping(tmp_path: Path) -> None:
    keys = ["solver.warp=false", "solver.projection=none", "solver.preconditioner=block_jacobi"]
    exact = frequency_in_matrix(sliver_bar(keys, tmp_path, cells=(2, 2, 6)))
    sim = sliver_bar(["integrator.scheme=central_difference", "solver.preconditioner=none"], tmp_path, cells=(2, 2, 6))
    sim.engine.run(1)
    assert 0.97 < sim.engine.records()["stable_step"][0] * exact / 2 < 1.03
    body = bar((3, 1, 1), young=1e5)
    w = largest_frequency([body])
    damped = explicit({**body, "effects": {**body["effects"], "rayleigh": {"stiffness": 0.01}}})
    damped.engine.run(1)
    z = 0.01 * w / 2
    assert damped.engine.records()["stable_step"][0] == pytest.approx(2 / w * (np.sqrt(1 + z * z) - z), rel=0.06)


def test_a_body_that_stiffens_keeps_its_energy() -> None:
    """A soft beam falls onto itself: its elements are crushed to a fraction of their size within a few steps."""
    body = {**bar((12, 3, 3), (4, 1, 1), fixed="X < 0.01"), "effects": {"fixed": {"where": "X < 0.01"}}}
    body["effects"]["stable_neo_hookean"] = {"young": 1e5, "poisson": 0.45}
    sim = explicit(body, dt=0.02, gravity=(0, 0, -9.8))
    sim.engine.loop.energy_every = 1
    sim.engine.run(150)
    r = sim.engine.records()
    error = np.abs(r["kinetic"] + r["elastic"] - r["budget"]) / r["budget"].max()
    assert (r["status"] == 0).all() and error.max() < 5e-3
    assert r["substeps"].max() > r["substeps"].min()


def test_what_a_step_tells(tmp_path: Path) -> None:
    sim = explicit(bar((2, 1, 1), young=1e6))
    sim.engine.run(3)
    r = sim.engine.records()
    assert not r["iterations"].any() and not r["residual"].any() and (r["factor_step"] == -1).all()
    assert (r["substeps"] > 1).all() and (r["contacts"] == 0).all() and not sim.scene.solver.wants_factors
    implicit = simulation(bar((2, 1, 1)), preconditioner="none")
    implicit.engine.run(1)
    r = implicit.engine.records()
    assert r["substeps"][0] == 0 and np.isnan(r["stable_step"][0])


def test_the_same_run_has_the_same_bits() -> None:
    def run(*parts: int, threads: int = 1) -> NDArray[np.float64]:
        sim = explicit(bar((4, 2, 2), young=1e5, fixed="X < 0.01"), gravity=(0, 0, -9.8), threads=threads)
        for steps in parts:
            sim.engine.run(steps)
        return np.stack([sim.world.x, sim.world.v])

    assert (run(30) == run(10, 20)).all() and (run(30) == run(30, threads=2)).all()


def test_a_body_without_forces_goes_back_and_rests() -> None:
    body = {**bar((2, 1, 1)), "effects": {"neo_hookean": {"young": 1e5, "poisson": 0.3}}}
    sim = explicit(body, dt=0.01)
    sim.world.x[0] = sim.world.x[1] + [1.0, 0, 0]  # turned over
    start = sim.world.x.copy()
    sim.engine.run(2)
    r = sim.engine.records()
    assert (r["status"] == 5).all() and r["bad_node"][0] >= 0 and (sim.world.x == start).all() and not sim.world.v.any()


def test_a_fall_with_damping_of_the_mass() -> None:
    sim = explicit({**bar((1, 1, 1)), "effects": {"rayleigh": {"mass": 2.0}}}, dt=0.05, gravity=(0, 0, -9.8))
    sim.engine.run(300)
    assert np.allclose(sim.world.v, [0, 0, -4.9], rtol=1e-12)


def test_a_grab_is_part_of_the_stable_step_and_of_the_balance() -> None:
    sim = explicit(bar((2, 1, 1), young=1e4, fixed="X < 0.01", touch={"max_force": 1e9}), dt=0.02)
    sim.engine.loop.energy_every = 1
    sim.engine.run(1)
    before = sim.engine.records()["stable_step"][0]
    held = sim.touch.grab("me", "bar", (2, 0.5, 0.5), 0.8, (2.05, 0.5, 0.5), 2e4, 1e9, 60.0)
    sim.engine.run(40)
    r = sim.engine.records()
    assert (r["status"] == 0).all() and r["work"].max() > 10
    assert np.abs(r["kinetic"] + r["elastic"] - r["budget"]).max() < 0.05 * r["work"].max()
    sim.touch.release("me", held.id)
    sim.touch.grab("me", "bar", (2, 0.5, 0.5), 0.8, (2.05, 0.5, 0.5), 1e7, 1e9, 60.0)
    sim.engine.run(40)
    r = sim.engine.records()
    assert (r["status"] == 0).all() and r["stable_step"].max() < 0.1 * before and r["substeps"].min() > 1


MOVES = [{"time": 0.0}, {"time": 0.5, "translate": [0.1, 0.0, 0.05], "rotate": [20, 0, 0]}]


def test_a_holder_moves_and_tells_the_force() -> None:
    found = []
    for integrator, solver in ((EXPLICIT, {"preconditioner": "auto"}), ({"scheme": "newmark"}, {})):
        sim = held_bar(left(keyframes=MOVES), integrator=integrator, solver=solver, gravity=(0, 0, -9.8),
                       dt=0.002, damping=(1.0, 0.0))  # fmt: skip
        sim.engine.run(250)
        records, reactions = sim.engine.records_and_reactions()
        assert (records["status"] == 0).all()
        found.append((sim.world.x.copy(), reactions[-20:, 0].mean(axis=0)))
    (x, force), (other_x, other_force) = found
    assert np.abs(x - other_x).max() < 2e-3
    assert np.abs(force - other_force).max() < 0.02 * np.abs(other_force).max()


REFUSED = {
    "integrator": ({"integrator": {**EXPLICIT, "linearizations": 2}}, "it solves no equations; allowed: 1"),
    "solver": ({"solver": {"preconditioner": "cholesky"}}, 'which solves no equations; allowed: "auto", "none"'),
    "budget": ({"solver": {"budget": 0.1}}, "which solves no equations; allowed: 0"),
    "contact": (
        {"effects": {"contact": {}}, "obstacle": [{"name": "floor", "shape": "plane"}]},
        "contact with integrator.scheme = 'central_difference'",
    ),
    "spring": (
        {"spring": [{"name": "s", "stiffness": 1.0, "between": [
            {"object": "bar", "at": [0, 0, 0]}, {"object": "bar", "at": [2, 1, 1]}]}]},
        "allowed: 'backward_euler' with linearizations = 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_combine_is_refused(what: str) -> None:
    table, words = REFUSED[what]
    given = {"name": "test", "dt": 0.01, "object": [bar()], "integrator": EXPLICIT, **table}
    with pytest.raises(ValueError, match=words.replace(".", r"\.")):
        Scene.model_validate(given, context={"folder": "."})


def test_a_resolved_scene_is_valid_again() -> None:
    again = Scene.model_validate(scene(bar(), integrator=EXPLICIT).resolved(), context={"folder": "."})
    assert again.solver.preconditioner == "none" and not again.solver.warp and again.integrator.explicit
