# SPDX-License-Identifier: MIT
"""Grabs in Rosenbrock-W steps: springs that begin between two factors, and stiff ones."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

BEGINS = 12  # steps of 20 ms before the grab; a factor of step 10 comes in step 15, one of step 15 in step 20
BETA = 0.02  # s; the shock of a grab dies away


def falling(dt: float = 0.02, beta: float = BETA, woodbury: int = 32, solve: str = "auto") -> Simulation:
    held = bar(
        (6, 2, 2), (3, 1, 1), young=1e6, poisson=0.4, fixed="X < 0.01", damping=(1.0, beta), touch={"max_force": 1e9}
    )
    return simulation(
        held, gravity=(0, -9.81, 0), dt=dt, preconditioner="cholesky", update="lockstep-5", woodbury=woodbury,
        integrator={"scheme": "ros2", "solve": solve},
    )  # fmt: skip


def grab(sim: Simulation, stiffness: float) -> tuple[NDArray, NDArray]:
    """Grabs the six nodes at the middle of the free end; these, and where they are to go."""
    end = int(np.argmin(np.abs(sim.world.rest - [3, 0.5, 0.5]).sum(axis=1)))
    at = sim.world.x[end]
    way = np.array([0, 0.02, 0])
    target: Any = tuple(at + way)
    made = sim.touch.grab("client", "bar", tuple(at), 0.6, target, stiffness, 1e9, 10.0)
    assert len(made.nodes) == 6
    return made.nodes, sim.world.x[made.nodes] + way


def run(stiffness: float, refined: int = 1, **options: Any) -> tuple[NDArray, NDArray]:
    """Positions after each 20 ms from the grab on, (40, n, 3), and the records."""
    sim = falling(0.02 / refined, **options)
    driver, x, records = Driver(sim), [], []
    driver.advance(BEGINS * refined)
    nodes, goal = grab(sim, stiffness)
    for _ in range(40):
        records.append(driver.advance(refined))
        x.append(sim.world.x.copy())
    if stiffness >= 1e12:
        assert np.abs(sim.world.x[nodes] - goal).max() < 1e-5  # it is held
    return np.array(x), np.concatenate(records)


def apart(a: NDArray, b: NDArray) -> float:
    return float(np.linalg.norm(a - b, axis=2).max())


@pytest.mark.parametrize("stiffness", [1e8, 1e12])
def test_a_grab_that_begins_between_two_factors(stiffness):
    """The factor is corrected for it if it may be; if not, the body iterates until a factor knows the grab."""
    exact = run(stiffness, refined=8, solve="iterate")[0]
    iterated, _ = run(stiffness, solve="iterate")
    corrected, records = run(stiffness)
    assert (records["form"] == FORMS["FACTOR"]).all() and not records["iterations"].any()
    not_corrected, others = run(stiffness, woodbury=1)
    assert (others["form"] == [FORMS["ITERATE"]] * 8 + [FORMS["FACTOR"]] * 32).all()
    assert (records["status"] == pb.CONVERGED).all() and (others["status"] == pb.CONVERGED).all()
    error = apart(iterated, exact)
    assert error < 0.02
    for found in (corrected, not_corrected):
        assert apart(found, iterated) < 0.2 * error and apart(found, exact) < 1.2 * error


def test_the_correction_is_that_of_the_grabbed_nodes():
    sim = falling()
    driver = Driver(sim)
    driver.advance(BEGINS)
    assert sim.engine.corrected(0) == 0
    grab(sim, 1e8)
    driver.advance(1)
    assert sim.engine.corrected(0) == 6


def test_what_is_let_go_is_free_again():
    """The factor knows the grab; its springs are taken out, or the body iterates."""
    ends = {}
    for woodbury in (32, 1):
        sim = falling(woodbury=woodbury)
        driver = Driver(sim)
        driver.advance(BEGINS)
        grab(sim, 1e8)
        driver.advance(20)
        sim.touch.release("client", 1)
        records = driver.advance(20)
        ends[woodbury] = sim.world.x.copy()
        assert (records["form"][0] == FORMS["FACTOR"]) == (woodbury == 32)
        assert (records["form"][10:] == FORMS["FACTOR"]).all() and (records["status"] == pb.CONVERGED).all()
    assert np.linalg.norm(ends[32] - ends[1], axis=1).max() < 1e-3


@pytest.mark.parametrize("solve", ["iterate", "auto"])
@pytest.mark.parametrize("dt", [0.02, 0.0025])
@pytest.mark.parametrize("beta", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("stiffness", [1e8, 1e12, 1e14])
def test_a_stiff_grab_is_stable(stiffness, beta, dt, solve):
    """Also beside a stiffness that is damped, while the spring is not."""
    sim = falling(dt, beta, solve=solve)
    driver = Driver(sim)
    driver.advance(round(BEGINS * 0.02 / dt))
    grab(sim, stiffness)
    kinetic = []
    for _ in range(30):
        records = driver.advance(1)
        assert records["status"][0] == pb.CONVERGED
        assert records["form"][0] != FORMS["EULER"] or stiffness == 1e14  # of which rounding is a part
        kinetic.append(sim.kinetic_energy())
    assert max(kinetic[10:]) < max(kinetic[:3])
    if stiffness >= 1e12:
        assert kinetic[1] < 0.5 * kinetic[0]
