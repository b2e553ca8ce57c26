# SPDX-License-Identifier: MIT
"""States that no run should reach by itself: Rosenbrock-W steps go back to backward Euler there, and only there."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.rosenbrock import FORMS
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.starts import Start, mirrored, randomly_placed, spinning, stretched
from tests.scenes import bar, simulation

STARTS: dict[str, Start] = {
    "stretched": stretched(3.0),
    "pressed": stretched(0.2),
    "inside out": mirrored(0),
    "random": randomly_placed(1),
    "spun": spinning(20.0),
}
SOLVERS: dict[str, dict[str, Any]] = {
    "iterate": {"solve": "iterate", "update": "lockstep-3"},
    "factor, age 1": {"solve": "auto", "update": "lockstep-1"},
    "factor, age 3-5": {"solve": "auto", "update": "lockstep-3"},
}


def upright(
    solver: str, damping: float = 2.0, young: float = 1e6, fixed: str | None = "Z < 0.01", **scene: Any
) -> Simulation:
    """1 x 1 x 4 m, nearly incompressible, steps of 20 ms."""
    solve, update = SOLVERS[solver].values()
    table: dict[str, Any] = {"corotational": {"young": young, "poisson": 0.45}, "rayleigh": {"mass": damping}}
    table |= {"fixed": {"where": fixed}} if fixed else {}
    held = {**bar((2, 2, 8), (1, 1, 4), young=None), "effects": table}
    return simulation(
        held, preconditioner="cholesky", update=update, integrator={"scheme": "ros2", "solve": solve}, **scene
    )


def energy(sim: Simulation) -> float:
    return sim.kinetic_energy() + sim.potential_energy()


def run(sim: Simulation, steps: int) -> tuple[NDArray, NDArray]:
    """Energies before the first and after each step; records."""
    driver, history = Driver(sim), [energy(sim)]
    records: list[NDArray] = []
    for _ in range(steps):
        records.append(driver.advance(1))
        history.append(energy(sim))
    return np.array(history), np.concatenate(records)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("start", STARTS)
def test_it_comes_to_rest(start, solver):
    sim = upright(solver, fixed=None if start == "spun" else "Z < 0.01")
    STARTS[start](sim)
    history, records = run(sim, 300)
    goes_back = records["form"] == FORMS["EULER"]
    assert goes_back[:2].any() and not goes_back[150:].any()
    assert (records["status"] == pb.CONVERGED).all()
    assert (records["form"][150:] == FORMS["ITERATE" if solver == "iterate" else "FACTOR"]).mean() > 0.9
    assert history.max() < history[0] * (1.2 if start == "spun" else 1 + 1e-9)  # backward Euler lets it rise there
    assert history[50] < 0.1 * history[0] and history[-1] < 2e-3 * history[0]  # folded through itself, at the worst
    assert sim.kinetic_energy() < 1e-6 * history[0]
    assert np.diff(history).max() < 0.01 * history[0] or start == "spun"


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("young", [1e5, 1e6, 1e7])
def test_a_beam_that_is_let_go_never_goes_back(young, solver):
    """From the horizontal, without damping."""
    sim = upright(solver, 0.0, young, gravity=(0, -9.81, 0))
    records = Driver(sim).advance(200)
    assert not (records["form"] == FORMS["EULER"]).any() and records["estimate"].max() > 0
    assert (records["status"] == pb.CONVERGED).all()
