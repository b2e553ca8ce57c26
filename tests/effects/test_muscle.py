# SPDX-License-Identifier: MIT
"""Muscle: isometric force, free shortening, beats, the tangent, work, and what is refused."""

from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene

PLANES = [{"where": f"{axis.upper()} < 0.01", "along": axis} for axis in "xyz"]
STATIC = {"scheme": "quasi_static", "linearizations": 10}
STRESS = 2e4


def bar_with(muscle: Any, integrator: dict | None = None, fixed: Any = None, **table: Any) -> Simulation:
    """A bar of 2 m along x and a section of 1 m2, without contraction across."""
    solver, dt = table.pop("solver", {}), table.pop("dt", 0.02)
    given = bar(density=1000, **({"poisson": 0.0} | table))
    given["effects"] |= {"muscle": muscle} | ({"fixed": fixed} if fixed else {})
    return Simulation(scene(given, integrator=integrator, dt=dt, **solver))


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["muscle"].load.copy())  # type: ignore[attr-defined]


def total(force: np.ndarray, sim: Simulation) -> float:
    """Sum along x over the nodes of the end x = 0."""
    return float(force[sim.world.rest[:, 0] < 0.01, 0].sum())


@pytest.mark.parametrize(
    ("integrator", "dt", "steps"),
    [(STATIC, 1.0, 3), ({}, 1.0, 30), ({"scheme": "ros2", "solve": "iterate"}, 1.0, 60)],
)
def test_a_free_bar_shortens_by_stress_over_young(integrator, dt, steps):
    """l = 1 - T / young, the minimum of young (l - 1)^2 / 2 + T (l - 1)."""
    sim = bar_with({"stress": STRESS, "direction": [3, 0, 0]}, integrator, PLANES, dt=dt, solver={"tolerance": 1e-12})
    Driver(sim).advance(steps)
    np.testing.assert_allclose(sim.fetch().x, sim.world.rest * [1 - STRESS / 1e5, 1, 1], atol=1e-6)
    sim.parameters.set({"bar.muscle.activation": "0.5"})
    Driver(sim).advance(steps)
    np.testing.assert_allclose(sim.fetch().x, sim.world.rest * [1 - 0.5 * STRESS / 1e5, 1, 1], atol=1e-6)


def held(muscle: dict[str, Any]) -> Simulation:
    given = bar(density=1000, poisson=0.0, fixed="X < 0.01")
    given["effects"]["muscle"] = muscle
    table = {"name": "held", "dt": 0.02, "object": [given], "integrator": {"scheme": "quasi_static"},
             "holder": [{"name": "grip", "object": "bar", "where": "X > 1.99"}]}  # fmt: skip
    return Simulation(Scene.model_validate(table, context={"folder": "."}))


def test_a_bar_that_is_held_pulls_with_stress_times_area():
    sim = held({"stress": STRESS, "direction": [1, 0, 0], "activation": 0.75})
    sim.engine.run(3)
    reaction = sim.engine.records_and_reactions()[1]
    np.testing.assert_allclose(reaction[-1, 0, :3], [-0.75 * STRESS, 0, 0], atol=1e-5 * STRESS)
    assert total(forces(sim), sim) == pytest.approx(0.75 * STRESS)


def test_force_and_length():
    """The parabola of optimum and width, by the length at which the bar is held."""
    muscle = {"stress": STRESS, "direction": [1, 0, 0], "optimum": 1.1, "width": 0.5}
    sim = bar_with(muscle)
    rest = sim.world.x.copy()
    for stretch in (0.5, 0.7, 1.0, 1.1, 1.4, 1.7):
        sim.world.x[:] = rest * [stretch, 0.8, 1]
        expected = STRESS * max(0.0, 1 - ((stretch - 1.1) / 0.5) ** 2)
        assert total(forces(sim), sim) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_forces_have_neither_sum_nor_torque_and_turn_with_the_body():
    sim = bar_with({"stress": STRESS, "direction": [1, 2, -1], "width": 0.6})
    sim.world.x[:] += 0.1 * np.random.default_rng(0).normal(size=sim.world.x.shape)
    force = forces(sim)
    assert np.abs(force).max() > 100
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(sim.world.x, force).sum(axis=0), 0, atol=1e-9)


def matrix(sim: Simulation) -> np.ndarray:
    sim.engine.assemble()
    return sim.matrix().toarray()


def test_the_tangent_is_the_slope_of_the_forces():
    """On the ascending branch all of it; A has h^2 times its negative."""
    muscle = {"stress": STRESS, "direction": [1, 0.4, 0], "optimum": 2.5, "width": 3.0}
    sim, passive = (bar_with(m, cells=(2, 1, 1), solver={"warp": False}) for m in (muscle, muscle | {"stress": 0.0}))
    sim.world.x[:] += 0.05 * np.random.default_rng(1).normal(size=sim.world.x.shape)
    passive.world.x[:] = sim.world.x
    found = (matrix(sim) - matrix(passive)) / sim.world.dt**2
    x, slopes = sim.world.x.copy(), []
    for k in range(x.size):
        each = []
        for sign in (1, -1):
            sim.world.x[:] = x
            sim.world.x.ravel()[k] += sign * 1e-5
            each.append(forces(sim).ravel())
        slopes.append((each[1] - each[0]) / 2e-5)
    np.testing.assert_allclose(found, np.array(slopes), atol=1e-6 * np.abs(found).max())
    assert np.linalg.eigvalsh(found).min() > -1e-9 * np.abs(found).max()


def test_the_descending_branch_leaves_the_matrix_semi_definite():
    muscle = {"stress": STRESS, "direction": [1, 0, 0], "optimum": 0.5, "width": 1.0}
    sim, passive = (bar_with(m, cells=(2, 1, 1), solver={"warp": False}) for m in (muscle, muscle | {"stress": 0.0}))
    assert total(forces(sim), sim) == pytest.approx(0.75 * STRESS)
    assert np.linalg.eigvalsh(matrix(sim) - matrix(passive)).min() > -1e-9


def test_beats_and_waves():
    """The pulse at the end of each step of backward Euler, later by `phase` in the second half."""
    regions = [{"where": "X < 1", "stress": STRESS}, {"stress": STRESS, "phase": 0.25}]
    muscle = {"stress": regions, "direction": [1, 0, 0], "period": 0.4, "duty": 0.6}
    sim = bar_with(muscle, fixed={"where": "X < 0.9 or X > 1.1"})
    ends = sim.world.rest[:, 0] < 0.01, sim.world.rest[:, 0] > 1.99
    for step in range(60):
        sim.engine.run(1)
        for end, phase, sign in ((ends[0], 0.0, 1), (ends[1], 0.25, -1)):
            s = ((step + 1) * 0.02 / 0.4 - phase) % 1 / 0.6
            expected = STRESS * 16 * s**2 * (1 - s) ** 2 if s < 1 else 0.0
            force = sign * float(sim.effects["muscle"].load[end, 0].sum())  # type: ignore[attr-defined]
            assert force == pytest.approx(expected, abs=1e-6 * STRESS)


@pytest.mark.parametrize("scheme", ["ros2", "generalized_alpha", "central_difference"])
def test_what_a_beating_bar_does_is_in_its_energy(scheme):
    solver = {} if scheme == "central_difference" else {"tolerance": 1e-10}
    integrator = {"scheme": scheme} | ({"solve": "iterate"} if scheme == "ros2" else {})
    muscle = {"stress": STRESS, "direction": [1, 0, 0], "period": 0.5}
    sim = bar_with(muscle, integrator, PLANES, dt=0.005, solver=solver)
    records = Driver(sim).advance(100)
    energy = sim.kinetic_energy() + sim.potential_energy()
    assert (records["status"] == 0).all() and energy > 100
    assert energy == pytest.approx(records["work"][-1], rel=0.02)


def test_work_of_a_beating_bar_bounds_its_energy():
    """Backward Euler: work is that of the force as applied, so the budget bounds the energy however long it beats."""
    muscle = {"stress": 8e4, "direction": [1, 0, 0], "period": 0.3, "duty": 1.0}
    sim = bar_with(muscle, fixed=[{"where": "X < 0.01"}], elements="smoothed", poisson=0.3)
    records = Driver(sim).advance(400)
    assert (records["status"] == 0).all()
    assert records["kinetic"].max() > 10
    assert (records["kinetic"] <= records["work"] + 1e-9).all()


@pytest.mark.parametrize("scheme", ["newmark", "generalized_alpha"])
def test_a_bar_that_beats_faster_than_it_swings_has_not_run_away(scheme):
    """The work of its muscle has errors that add up, and comes out below zero in the end."""
    muscle = {"stress": 3e4, "direction": [1, 0, 0], "period": 0.08, "duty": 1.0}
    sim = bar_with(muscle, {"scheme": scheme}, [{"where": "X < 0.01"}], cells=(4, 1, 1), damping=(0.5, 0.002))
    records = Driver(sim).advance(800)
    assert (records["status"] == 0).all() and records["kinetic"][-1] < 100 and records["work"][-1] < 0


@pytest.mark.parametrize(
    ("muscle", "said"),
    [
        ({"stress": STRESS}, "direction"),
        ({"stress": STRESS, "direction": [0, 0, 0]}, "must not be zero"),
        ({"stress": STRESS, "direction": [1, 0, 0], "activation": 1.5}, "less than or equal to 1"),
        ({"stress": -1.0, "direction": [1, 0, 0]}, "greater than or equal to 0"),
        ({"stress": STRESS, "direction": [1, 0, 0], "duty": 0.0}, "greater than 0"),
        ({"stress": [{"where": "X < 1", "stress": 1.0}], "direction": [1, 0, 0]}, "is in no region"),
    ],
)
def test_what_is_refused(muscle, said):
    with pytest.raises((InputError, ValueError), match=said):
        bar_with(muscle)


MUSCLE = {"muscle": {"stress": STRESS, "direction": [1, 0, 0]}}
WIRE = {"rod": {"path": [[0.1, 0.5, 0.5], [1.9, 0.5, 0.5]], "young": 1e7, "radius": 0.01}}
CAPSULE = {"membrane": {"young": 1e5, "poisson": 0.3, "thickness": 0.01}}
PORES = {"poroelasticity": {"mobility": 1e-9, "storage": 1e5}}
VISCOUS = {"prony": {"terms": [{"g": 1.0, "tau": 1.0}], "shear": 1e4}}


@pytest.mark.parametrize(
    ("effects", "named"),
    [(MUSCLE, "muscle"), (MUSCLE | WIRE, "muscle"), (MUSCLE | CAPSULE, "muscle"), (MUSCLE | PORES, "muscle"),
     (PORES, "poroelasticity"), (VISCOUS | WIRE, "prony")],
)  # fmt: skip
def test_what_gives_no_shape_is_refused_without_a_material(effects, named):
    with pytest.raises(InputError, match=f"'bar', effect {named}: nothing beside it .* list a material beside it"):
        Simulation(scene(bar((2, 1, 1), young=None, effects=effects)))
