# SPDX-License-Identifier: MIT
"""Rosenbrock-W steps under the update policies: whose factor makes a step, what the loop copies for the next one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, simulation

F, I = FORMS["FACTOR"], FORMS["ITERATE"]  # noqa: E741


def falling(update: str = "never", solve: str = "auto") -> Simulation:
    held = bar((4, 2, 2), young=1e6, fixed="X < 0.01", damping=(0.1, 0.01))
    integrator = {"scheme": "ros2", "solve": solve}
    return simulation(held, gravity=(0, -9.81, 0), preconditioner="cholesky", update=update, integrator=integrator)


MADE_BY = {
    "never": [0] * 8,
    "every-1": list(range(8)),
    "every-2": [0, 0, 2, 2, 4, 4, 6, 6],
    "lockstep-1": [-1, 0, 1, 2, 3, 4, 5, 6],
    "lockstep-3": [-1, -1, -1, 0, 0, 0, 3, 3],
}


@pytest.mark.parametrize("update", MADE_BY)
def test_each_step_is_made_by_the_factor_in_use(update):
    records = Driver(falling(update)).advance(8)
    assert records["factor_step"].tolist() == MADE_BY[update]
    assert records["form"].tolist() == [F if made >= 0 else I for made in MADE_BY[update]]
    assert ((records["iterations"] == 0) == (records["form"] == F)).all()
    assert (records["residual"] >= 0).all()


@pytest.mark.parametrize("update", MADE_BY)
def test_a_run_repeats_bit_for_bit(update):
    sims = [falling(update) for _ in range(2)]
    records = [Driver(sim).advance(20) for sim in sims]
    assert np.array_equal(sims[0].world.x, sims[1].world.x) and np.array_equal(sims[0].world.v, sims[1].world.v)
    for column in ("form", "estimate", "residual", "iterations", "factor_step"):
        assert np.array_equal(records[0][column], records[1][column], equal_nan=True)


def with_factor(solve: str = "auto") -> Simulation:
    """After four steps, with the factor of the matrix of the third."""
    sim = falling(solve=solve)
    sim.engine.run(2)
    sim.engine.assemble()
    sim.engine.post_factor(0, *factor_of(sim, 0, np.float32), 2)
    sim.engine.run(2)
    return sim


@pytest.mark.parametrize("solve", ["auto", "iterate"])
def test_a_step_of_two_halves_is_the_same_bit_for_bit(solve):
    once, twice = with_factor(solve), with_factor(solve)
    once.engine.run(20)
    for _ in range(20):
        twice.engine.assemble()
        twice.engine.solve()
    assert np.array_equal(once.world.x, twice.world.x) and np.array_equal(once.world.v, twice.world.v)
    a, b = once.engine.records(), twice.engine.records()
    assert np.array_equal(a["form"], b["form"]) and np.array_equal(a["residual"], b["residual"], equal_nan=True)
    assert (a["form"][2:] == (F if solve == "auto" else I)).all()


def test_a_factor_posted_between_the_halves_makes_the_step():
    sim = falling()
    sim.engine.run(2)
    sim.engine.assemble()
    sim.engine.post_factor(0, *factor_of(sim, 0, np.float64), 2)
    sim.engine.solve()
    records = sim.engine.records()
    assert records["form"].tolist() == [I, I, F] and records["factor_step"].tolist() == [-1, -1, 2]
    assert records["residual"][2] < 1e-3  # it is that of its own matrix; the check is exact for linear forces only


def matrix_at(sim: Simulation) -> NDArray:
    """A of the present state, assembled by another simulation."""
    other = falling()
    other.world.x[:], other.world.v[:] = sim.world.x, sim.world.v
    other.engine.assemble()
    return other.system.values.copy()


def test_the_matrix_is_assembled_where_a_copy_is_asked_for():
    """A step by the factor alone does not make one for itself."""
    sim = with_factor()
    before, target = sim.system.values.copy(), np.zeros_like(sim.system.values)
    assert not np.array_equal(matrix_at(sim), before)
    sim.engine.run(1)
    assert np.array_equal(sim.system.values[: sim.system.row_start[-1]][sim.system.upper], before[sim.system.upper])
    expected = matrix_at(sim)
    sim.engine.request_matrix(0, target)
    sim.engine.run(1)
    assert sim.engine.matrix_step(0) == 5 and np.array_equal(target, expected)
    assert (sim.engine.records()["form"][2:] == F).all()


@pytest.mark.parametrize("ahead", [0.0, 0.05])
def test_positions_are_copied_as_they_are(ahead):
    sim = with_factor()
    target = np.zeros_like(sim.world.x)
    expected = sim.world.x + ahead * sim.world.v
    sim.engine.request_positions(0, target, ahead)
    sim.engine.run(1)
    np.testing.assert_allclose(target, expected, rtol=1e-15, atol=1e-15)
    assert sim.engine.matrix_step(0) == 4 and sim.engine.records()["form"][-1] == F
