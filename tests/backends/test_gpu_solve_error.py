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


def falling(position: float | str, **table: Any) -> Simulation:
    """A bar of 2 m that is let go from horizontal, held at its left end."""
    beam = bar((6, 2, 2), young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    options = {"preconditioner": "cholesky", "update": "never", "max_iterations": 5000, "tolerance": 1e-12} | table
    return bounded(simulation(beam, gravity=(0, -9.81, 0), **options), position)


def solved(solver: Solver, library: c.CDLL) -> tuple[Any, Any]:
    ours, theirs = solver.solve(library)
    assert ours["status"] == theirs["status"] == 0
    return ours, theirs


def test_x(library, monkeypatch):
    for position in (1e-2, 1e-3, 1e-4, 1e-6):
        solver = Solver(falling(position), monkeypatch, blocks=3)
        for step in range(6):
            ours, theirs = solved(solver, library)
            print(position, step, ours["kind"], ours["iterations"], theirs["iterations"], ours["solve_error"], theirs["solve_error"], ours["residual"], theirs["residual"])
            if step == 2:
                solver.post(solver.matrix, step)
