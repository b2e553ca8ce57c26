# SPDX-License-Identifier: MIT
"""Solves of a GPU that end by the estimated error of positions, beside those of a CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, STEP, ContactSolver, Solver, compiled
from tests.contact.scenes import over
from tests.scenes import bar, simulation

OPTIONS: dict[str, Any] = {"preconditioner": "cholesky", "update": "never", "max_iterations": 5000, "tolerance": 1e-12}


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("solver"), SOLVE, "ERRORS")


@pytest.fixture(scope="module")
def contact_library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("contact_solver"), STEP, "ERRORS", "CONTACT_PASSES")


def bounded(sim: Simulation, position: float | str) -> Simulation:
    """The scene again, with a bound of the error."""
    table = sim.scene.resolved() | {"accuracy": {"position": position}}
    return Simulation(Scene.model_validate(table, context={"folder": "."}))


def falling(position: float | str) -> Simulation:
    """A bar of 2 m that is let go from horizontal, held at its left end."""
    beam = bar((6, 2, 2), young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    return bounded(simulation(beam, gravity=(0, -9.81, 0), **OPTIONS), position)


def compared(solver: Solver, library: c.CDLL, within: float) -> int:
    """Makes a step of both; returns their iterations. within: part by which the estimates may differ."""
    ours, theirs = solver.solve(library)
    assert ours["status"] == theirs["status"] == 0 and ours["kind"] == theirs["kind"]
    assert ours["iterations"] == theirs["iterations"]
    assert ours["solve_error"] == pytest.approx(theirs["solve_error"], rel=within)
    return int(ours["iterations"])


def test_solves_end_where_those_of_a_cpu_do(library, monkeypatch):
    """With block Jacobi, then with a factor that becomes older, at last with a hand that it does not know; inverses of
    a GPU have float16 numbers. Thread blocks exchange values."""
    solver = Solver(falling(1e-5), monkeypatch, blocks=3)
    iterations = [compared(solver, library, 1e-9) for _ in range(2)]
    assert min(iterations) > 10, "x is looked at more than once"
    solver.post(solver.matrix, 1)
    assert compared(solver, library, 0.3) <= 2 and compared(solver, library, 0.3) <= 2
    diagonal = solver.sim.system.diagonal + solver.sim.system.block[:, [0, 3, 5]].sum(axis=1) / 3
    stiffness = 300 * float(diagonal[-1]) / solver.sim.world.dt**2
    solver.sim.touch.grab("anna", "bar", (2.0, 1.0, 0.5), 0.6, (2.0, 1.1, 0.5), stiffness, 0.0, np.inf)
    assert compared(solver, library, 0.3) > 1 and solver.used > 0


def test_coarser_bounds_take_fewer_iterations(library, monkeypatch):
    """One of percent, too."""
    found = [compared(Solver(falling(position), monkeypatch), library, 1e-9) for position in (1e-6, "0.05 %")]
    assert found[1] < found[0] / 2


def test_the_last_pass_of_contact_ends_by_the_error(contact_library, monkeypatch):
    """A block falls onto a floor; the solves before have the same iterations as on a CPU, too."""
    found = []
    for position in (1e-5, 1e-10):
        made = over(cells=(2, 1, 2), at=(0, 0.006, 0), solver=OPTIONS)
        solver = ContactSolver(bounded(made, position), monkeypatch)
        found.append([compared(solver, contact_library, 1e-5) for _ in range(3)])
    assert sum(found[0]) < sum(found[1])
