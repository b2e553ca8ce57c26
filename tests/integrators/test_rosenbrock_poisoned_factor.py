# SPDX-License-Identifier: MIT
"""A factor that is wrong is found in the step that uses it first, which is then made by iterations, as are the next."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.backends.declarations import Declarations
from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from tests.scenes import bar, factor_of, simulation

BEFORE, AFTER = 10, 30  # steps before the factor comes, after it
FORM = Declarations("kernels/step_form.h")
PATIENCE, INCONSISTENT = FORM.constant("PATIENCE"), FORM.constant("INCONSISTENT")
POISONS = ["scaled", "column", "permuted", "nan"]


def swinging(solve: str = "auto", dt: float = 0.02) -> Simulation:
    held = bar((6, 2, 2), (3, 1, 1), young=1e6, poisson=0.45, fixed="X < 0.01", damping=(0.1, 0))
    integrator = {"scheme": "ros2", "solve": solve}
    return simulation(held, gravity=(0, -9.81, 0), dt=dt, preconditioner="cholesky", integrator=integrator)


def poisoned(pattern: FactorPattern, values: NDArray, how: str) -> NDArray:
    """The values of L with some of them wrong. The columns of a supernode are one after another, the first is whole."""
    width, height = np.diff(pattern.super_start), np.diff(pattern.row_start)
    start = np.concatenate([[0], np.cumsum(width * height - width * (width - 1) // 2)])
    k = len(width) // 2
    values = values.copy()
    if how == "scaled":
        values *= 3
    elif how == "column":
        values[start[k] : start[k] + height[k]] *= 0.01
    elif how == "permuted":
        values = np.random.default_rng(0).permutation(values)
    elif how == "negative":
        values[start[-2]] *= -1  # of the last supernode
    elif how == "nan":
        values[start[k]] = np.nan
    return values


def run(sim: Simulation, how: str | None = None) -> tuple[NDArray, NDArray]:
    """Positions after each step since the factor came, and their records. how: of the poison; None: no factor."""
    sim.engine.run(BEFORE)
    if how is not None:
        sim.engine.assemble()
        pattern, values = factor_of(sim, 0, np.float32)
        sim.engine.post_factor(0, pattern, poisoned(pattern, values, how), BEFORE)
    found = []
    for _ in range(AFTER):
        sim.engine.run(1)
        found.append(sim.world.x.copy())
    return np.array(found), sim.engine.records()[BEFORE:]


@cache
def exact() -> NDArray:
    """Positions at the same times, with an eighth of the step."""
    sim, found = swinging("iterate", 0.02 / 8), []
    for _ in range(BEFORE + AFTER):
        sim.engine.run(8)
        found.append(sim.world.x.copy())
    return np.array(found)[BEFORE:]


def error(x: NDArray) -> float:
    return float(np.linalg.norm(x - exact(), axis=2).max())


@cache
def clean() -> float:
    """Error of the run with a good factor [m]."""
    x, records = run(swinging(), "good")
    assert (records["form"] == FORMS["FACTOR"]).all() and records["fallbacks"].sum() == 0
    return error(x)


@pytest.mark.parametrize("how", POISONS)
def test_a_poisoned_factor_costs_iterations_but_no_accuracy(how):
    iterated, _ = run(swinging("iterate"))
    x, records = run(swinging(), how)
    assert np.abs(x[:PATIENCE] - iterated[:PATIENCE]).max() < 1e-5  # to the tolerance of the solves
    assert (records["form"][: PATIENCE + 1] == FORMS["ITERATE"]).all()
    assert (records["iterations"][: PATIENCE + 1] > 0).all()
    assert (records["residual"][: PATIENCE + 1] <= 1e-6).all()
    assert records["fallbacks"][0] > 0 and (records["status"] == 0).all()
    assert clean() < 5e-3 and error(x) < 2 * clean()


def test_what_no_check_of_a_step_sees_stays_below_the_error_bound():
    """One pivot of the wrong sign is wrong at one node. A server that has the matrix refuses such a factor
    (tests/updates/test_factor_check.py)."""
    sim = swinging()
    x, records = run(sim, "negative")
    alone = records["form"] == FORMS["FACTOR"]
    assert (records["estimate"][alone] <= sim.integrator.bound[0]).all()
    assert error(x) < 2 * sim.integrator.bound[0]


def test_it_is_checked_again_before_each_use():
    """The factor that is three times too large is found again and again, never used."""
    _, records = run(swinging(), "scaled")
    assert (records["form"] == FORMS["ITERATE"]).all()
    assert np.flatnonzero(records["fallbacks"]).tolist() == [0, 9, 18, 27]


def test_a_good_factor_ends_the_patience():
    sim = swinging()
    run(sim, "permuted")
    sim.engine.assemble()
    sim.engine.post_factor(0, *factor_of(sim, 0, np.float32), sim.engine.step)
    sim.engine.run(20)
    records = sim.engine.records()
    assert (records["form"] == FORMS["FACTOR"]).all() and records["fallbacks"].sum() == 0
    assert 0 < records["residual"].max() < INCONSISTENT / 10


def test_patience_is_counted_in_steps_also_in_steps_of_two_halves():
    sim = swinging()
    run(sim, "scaled")
    for _ in range(20):
        sim.engine.assemble()
        sim.engine.solve()
    assert np.flatnonzero(sim.engine.records()["fallbacks"]).tolist() == [6, 15]
    assert Declarations("kernels/step_form.h").constant("PATIENCE") == PATIENCE
