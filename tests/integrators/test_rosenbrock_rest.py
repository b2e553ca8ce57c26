# SPDX-License-Identifier: MIT
"""Bodies at rest in Rosenbrock-W steps: not solved, standing still to the last bit until they are moved."""

import numpy as np
import pytest

from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

SOLVERS = {
    "iterations": {"preconditioner": "block_jacobi"},
    "factor alone": {"preconditioner": "cholesky", "update": "lockstep-3"},
}


def hanging(solver: str, far: float = 0.0) -> Simulation:
    """A beam under gravity that comes to rest soon, and one that swings without damping."""
    pose = {"translate": [far, 0, 0]}
    beam = bar((4, 2, 2), young=1e6, fixed="X < 0.01", damping=(20.0, 0.02), pose=pose, touch=True)
    other = bar((2, 1, 1), (2, 1, 1), name="other", young=1e6, fixed="X < 0.01")
    return simulation(beam, other, gravity=(0, -9.81, 0), integrator={"scheme": "ros2"}, **SOLVERS[solver])


@pytest.mark.parametrize("far", [0.0, 1e6])
@pytest.mark.parametrize("solver", SOLVERS)
def test_it_stands_still_to_the_bit_beside_one_that_moves(solver, far):
    sim = hanging(solver, far)
    driver = Driver(sim)
    driver.advance(600)
    nodes = sim.world.bodies[0].nodes
    x = sim.world.x.copy()
    records = driver.advance(200)
    of_it = records[records["body"] == 0]
    assert not of_it["iterations"].any() and not records["status"].any() and not of_it["estimate"].any()
    assert np.array_equal(sim.world.x[nodes], x[nodes]) and not sim.world.v[nodes].any()
    assert (sim.world.x != x)[sim.world.bodies[1].nodes].any()
    form = "FACTOR" if solver == "factor alone" else "ITERATE"
    assert (records["form"] == FORMS[form]).all()
    assert not (records["fallbacks"]).any()


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_push_wakes_it_in_the_step_in_which_it_comes(solver):
    sim = hanging(solver)
    driver = Driver(sim)
    driver.advance(600)
    x = sim.world.x.copy()
    sim.touch.push("test", "bar", (2.0, 0.5, 0.5), 0.3, (0.0, 1e-3, 0.0), 0.1)
    records = driver.advance(1)
    assert records["estimate"][0] > 0
    assert np.abs(sim.world.v[sim.world.bodies[0].nodes]).max() > 1e-12
    assert (sim.world.x != x)[sim.world.bodies[0].nodes].any()
