# SPDX-License-Identifier: MIT
"""Several linearizations a step: what is solved, how fast, and what it costs."""

from itertools import pairwise

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.physics.laws import law_bar
from tests.scenes import bar, simulation, solid

GRAVITY = (0.0, -9.81, 0.0)
SCHEMES = ["backward_euler", "newmark", "bdf2"]


def beam(dt: float = 0.03, *others: dict, **table) -> Simulation:
    table = {"tolerance": 1e-8, "preconditioner": "block_jacobi", "max_iterations": 3000, "gravity": GRAVITY} | table
    held = bar((6, 2, 2), (3, 1, 1), young=1e5, fixed="X < 0.01", damping=(0.2, 0.01))
    return simulation(held, *others, dt=dt, **table)


def test_what_is_solved_is_backward_euler():
    """(v' - v) M = h f(x', v') with x' = x + h v', by the plain reference's forces."""
    sim = beam(integrator={"linearizations": 30, "tolerance": 1e-9})
    sim.engine.run(10)
    before = sim.world.v.copy()
    sim.engine.run(1)
    record = sim.engine.records()[-1]
    assert record["status"] == 0 and record["nonlinear"] <= 1e-9 and 2 <= record["linearizations"] < 30
    body, h = solid(sim), sim.world.dt
    m, v = sim.world.mass[:, None], sim.world.v
    damping = 0.2 * m * v + 0.01 * (body.tangent() @ v.ravel()).reshape(-1, 3)
    force = body.forces() - damping + m * np.array(GRAVITY)
    free = sim.world.free > 0
    rest = (m * (v - before) - h * force)[free]
    assert np.abs(rest).max() < 1e-8 * np.abs((m * (v - before))[free]).max()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_one_linearization_comes_to_the_same_as_the_step_shrinks(scheme):
    def difference(dt: float) -> float:
        once, often = beam(dt, integrator={"scheme": scheme}), beam(
            dt, integrator={"scheme": scheme, "linearizations": 20, "tolerance": 1e-9}
        )  # fmt: skip
        for sim in (once, often):
            sim.engine.run(round(0.24 / dt))
        return float(np.abs(once.world.x - often.world.x).max())

    coarse, fine = difference(0.03), difference(0.0075)
    assert fine < 0.4 * coarse < 0.4 * 2e-2


def test_each_linearization_takes_the_residual_down():
    """The residual falls by 30 to 50 each time, not quadratically: the corotational tangent is not exact."""
    left = []
    for most in (2, 3, 4, 5):
        sim = beam(integrator={"linearizations": most, "tolerance": 1e-14, "trials": 0}, tolerance=1e-10)
        sim.engine.run(10)
        left.append(sim.engine.records()["nonlinear"][-1])
    assert left[0] < 1e-3
    assert all(b < 0.05 * a for a, b in pairwise(left))


@pytest.mark.parametrize("law", ["neo_hookean", "stable_neo_hookean", "st_venant_kirchhoff"])
def test_convergence_is_quadratic_or_better_with_exact_tangents(law):
    """The exponent log(r3 / r2) / log(r2 / r1) of consecutive residuals."""
    left = []
    for most in (3, 4, 5):
        sim = law_bar(
            law, cells=(6, 2, 2), size=(3, 1, 1), fixed="X < 0.01", gravity=GRAVITY, dt=1.0, projection="none",
            integrator={"linearizations": most, "tolerance": 1e-15, "trials": 0, "scheme": "quasi_static"},
            tolerance=1e-12, preconditioner="block_jacobi", max_iterations=3000,
            table={"young": 1e6, "poisson": 0.3},
        )  # fmt: skip
        sim.engine.run(1)
        left.append(sim.engine.records()["nonlinear"][0])
    exponent = np.log(left[2] / left[1]) / np.log(left[1] / left[0])
    assert 1e-13 < left[2] < 1e-6 and exponent > 1.8, (left, exponent)


def test_larger_steps_are_stable_where_one_linearization_is_not():
    """A soft bar thrown against its clamp: energy of one linearization grows, of the solved equation it may not."""

    def energy(linearizations: int) -> list[float]:
        sim = simulation(
            bar((6, 2, 2), (3, 1, 1), young=2e4, poisson=0.45, fixed="X < 0.01"), dt=0.2, tolerance=1e-8,
            preconditioner="block_jacobi", max_iterations=5000,
            integrator={"linearizations": linearizations, "tolerance": 1e-6},
        )  # fmt: skip
        sim.world.v[:] = sim.world.free[:, None] * np.array([-10.0, 5.0, 0.0])
        out = [sim.kinetic_energy() + sim.potential_energy()]
        for _ in range(10):
            sim.engine.run(1)
            out.append(sim.kinetic_energy() + sim.potential_energy())
        return out

    once, solved = energy(1), energy(100)
    assert max(np.diff(solved)) <= 1e-6 * solved[0]
    assert max(np.diff(once)) > 1e-3 * once[0]


def test_bodies_are_solved_each_by_itself():
    """A body at rest beside a busy one takes no part in its linearizations, and changes nothing in it."""
    integrator = {"linearizations": 30, "tolerance": 1e-9}
    idle = bar((2, 1, 1), (1, 0.5, 0.5), name="idle", young=1e6, fixed="X < 0.01", pose={"translate": [0, 5, 0]})
    both = beam(0.03, idle, integrator=integrator, gravity=None)
    alone = beam(0.03, integrator=integrator, gravity=None)
    for sim in (both, alone):
        nodes = sim.world.bodies[0].nodes
        sim.world.v[nodes] = sim.world.free[nodes, None] * [0, -3.0, 0]
        sim.engine.run(5)
    assert np.array_equal(both.world.x[both.world.bodies[0].nodes], alone.world.x)
    assert np.array_equal(
        both.world.x[both.world.bodies[1].nodes], both.world.rest[both.world.bodies[1].nodes] + [0, 5, 0]
    )
    records = both.engine.records()
    assert (records["linearizations"][records["body"] == 1] == 1).all()
    assert (records["linearizations"][records["body"] == 0] > 1).all()


def test_threads_change_nothing():
    results = []
    for threads in (1, 2):
        other = bar((5, 2, 2), (3, 1, 1), name="b", young=3e4, fixed="X < 0.01", pose={"translate": [0, 5, 0]})
        sim = beam(0.03, other, integrator={"linearizations": 10}, threads=threads)
        sim.engine.run(10)
        results.append(sim.world.x.copy())
    assert np.array_equal(*results)


def test_linearizations_that_do_not_suffice_are_told():
    sim = beam(integrator={"linearizations": 2, "tolerance": 1e-12})
    sim.engine.run(2)
    records = sim.engine.records()
    assert (records["status"] == 6).all() and (records["linearizations"] == 2).all()
    assert (records["nonlinear"] > 1e-12).all() and (records["nonlinear"] < 0.1).all()


def test_a_force_that_is_not_finite_is_told_and_the_body_rests_as_with_one_linearization():
    for integrator in (None, {"linearizations": 10}):
        sim = beam(integrator=integrator)
        sim.engine.run(3)
        sim.world.x[20, 1] = np.nan
        sim.engine.run(1)
        assert sim.engine.records()["status"][-1] == 5
        assert not sim.world.v.any() and np.isfinite(np.delete(sim.world.x, 20, axis=0)).all()


def test_a_body_that_only_moves_as_a_whole_takes_one_linearization():
    """Rounding of the forces is no residual: the search ends there, whatever the tolerance."""
    sim = simulation(
        bar((4, 2, 2), young=1e6), dt=0.01, tolerance=1e-10, integrator={"linearizations": 20, "tolerance": 1e-12}
    )
    sim.world.v[:] = [1.0, 2.0, 3.0]
    sim.engine.run(20)
    records = sim.engine.records()
    assert (records["status"] == 0).all() and records["linearizations"].max() <= 2
    np.testing.assert_allclose(sim.world.x - sim.world.rest, np.tile([0.2, 0.4, 0.6], (sim.world.nodes, 1)), atol=1e-9)
