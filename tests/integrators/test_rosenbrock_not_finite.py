# SPDX-License-Identifier: MIT
"""A body whose forces are NaN in a Rosenbrock-W step: it goes back and rests there; the others take no notice."""

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

SOLVERS = {
    "iterations": {"preconditioner": "block_jacobi"},
    "factor alone": {"preconditioner": "cholesky", "update": "lockstep-3"},
}


def bodies(names: str, solver: str, threads: int) -> tuple[Simulation, Driver]:
    """a and b swing; n is of a law that J <= 0 is not defined in."""
    neo = {"neo_hookean": {"young": 1e6, "poisson": 0.3}, "fixed": {"where": "X < 0.01"}}
    given = {
        "a": bar((4, 2, 2), name="a", young=1e6, fixed="X < 0.01"),
        "n": bar((3, 2, 2), name="n", young=None, effects=neo),
        "b": bar((3, 1, 1), name="b", young=2e5, fixed="X < 0.01"),
    }
    sim = simulation(
        *(given[k] for k in names), gravity=(0, -9.81, 0), integrator={"scheme": "ros2"}, threads=threads,
        **SOLVERS[solver],
    )  # fmt: skip
    return sim, Driver(sim)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("solver", SOLVERS)
def test_it_goes_back_to_where_the_step_before_began(solver, threads):
    sim, driver = bodies("anb", solver, threads)
    nodes = sim.world.bodies[1].nodes
    driver.advance(9)
    before = sim.world.x[nodes].copy()
    driver.advance(1)
    sim.world.x[nodes.stop - 1] -= [3.0, 0.2, 0.1]  # through the held end
    records = driver.advance(1)
    assert records["status"].tolist() == [pb.CONVERGED, pb.NOT_FINITE, pb.CONVERGED]
    assert records["form"][1] == FORMS["EULER"] and records["bad_node"][1] >= 0 and records["bad_node"][0] == -1
    np.testing.assert_array_equal(sim.world.x[nodes], before)
    assert not sim.world.v[nodes].any() and sim.refusals()
    later = driver.advance(20)
    assert (later["status"] == pb.CONVERGED).all() and sim.world.v[nodes].any()
    for body in (sim.world.bodies[0], sim.world.bodies[2]):
        alone, own = bodies(body.name, solver, 1)
        own.advance(31)
        assert np.array_equal(sim.world.x[body.nodes], alone.world.x)
        assert np.array_equal(sim.world.v[body.nodes], alone.world.v)
