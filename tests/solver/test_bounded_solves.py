# SPDX-License-Identifier: MIT
"""Solves cut off by max_iterations or a time budget: more allowed is never worse; `auto` takes what gets furthest."""

import itertools

import numpy as np
import pytest

from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation
from tests.solver.solves import bent, solve

STEPS = 60


def swinging(preconditioner: str, **solver) -> Simulation:
    """A beam let go from horizontal, factors 3 to 5 steps old."""
    beam = bar((10, 3, 3), (4, 1, 1), young=1e6, poisson=0.45, fixed="X < 0.01", damping=(0.1, 0.0))
    solver |= {"preconditioner": preconditioner, "update": "lockstep-3"}
    return simulation(beam, gravity=(0, -9.81, 0), **solver)


def residuals(sim: Simulation) -> np.ndarray:
    """Residuals of the steps with a factor: those before the first one are left out."""
    return np.asarray(Driver(sim).advance(STEPS)["residual"][4:])


def test_more_iterations_allowed_are_never_worse():
    """Nor is a factor left after the first of two: what is left of so few is not enough for block Jacobi."""
    sims = [swinging("cholesky", max_iterations=most, tolerance=1e-12) for most in (1, 2, 3, 4)]
    medians = [float(np.median(residuals(sim))) for sim in sims]
    assert all(after < before for before, after in itertools.pairwise(medians)), medians
    assert medians[-1] < 1e-3 * medians[0]


@pytest.mark.parametrize("most", [8, 10])
def test_auto_takes_what_converges_within_the_iterations_allowed(most):
    """Block Jacobi takes some 60; cut off at 10 it costs a tenth of what the factor does, and misses by half of |b|."""
    free, capped = swinging("cholesky"), swinging("auto", max_iterations=most)
    Driver(free).advance(STEPS)
    records = Driver(capped).advance(STEPS)
    assert (records["status"][:3] == 1).all()  # no factor yet
    assert (records["status"][6:] == 0).all()
    best = swinging("cholesky", max_iterations=most)
    Driver(best).advance(STEPS)
    assert abs(capped.world.x - best.world.x).max() < 1e-3  # with the same first steps


def test_auto_takes_the_best_where_nothing_converges():
    assert np.median(residuals(swinging("auto", max_iterations=2))) < 1e-2


def test_a_budget_makes_one_iteration_at_least():
    """Else a body would fly on without its forces."""
    sim = swinging("block_jacobi", budget=1e-9)
    records = Driver(sim).advance(20)
    assert (records["iterations"] == 1).all()
    assert (records["status"] == 2).all()
    assert np.median(records["residual"]) < 0.7
    assert sim.world.x[:, 1].min() < -0.02  # it falls


@pytest.mark.parametrize("iterations", [0, 1, 4])
def test_a_budget_is_replayed_by_its_iterations(iterations):
    """To the bit; logs made when a budget could end with no iteration, too."""
    sim = bent()
    first, record = solve(sim, kind=Kind.NONE, max_iterations=iterations)
    assert record["iterations"] == iterations
    again, second = solve(sim, kind=Kind.NONE, max_iterations=500, budget=-float(iterations + 1))
    assert (second["iterations"], second["status"]) == (iterations, 2)
    assert np.array_equal(first, again)
