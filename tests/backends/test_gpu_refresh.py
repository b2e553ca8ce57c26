# SPDX-License-Identifier: MIT
"""Factors of a GPU that are refreshed where a body has changed most since their matrix (refresh_state.cuh)."""

import ctypes as c

import numpy as np
import pytest

from sim_server.backends.gpu.structs import REFRESH
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import REFRESHED_SOLVE, Solver, compiled
from tests.scenes import bar, simulation

MOST = REFRESH.constant("MOST_REFRESHED")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("solver"), REFRESHED_SOLVE, variant="REFRESHED")


def falling(stiff: float = 100.0) -> Simulation:
    """A beam that is stiff at its clamp and soft beyond, let go. stiff: how many times stiffer"""
    young = [{"where": "X < 1.5", "young": 2e4 * stiff}, {"young": 2e4}]
    beam = bar((6, 2, 2), young=young, fixed="X < 0.01", poisson=0.45)
    return simulation(beam, gravity=(0, -9.81, 0), preconditioner="cholesky", update="never", tolerance=1e-8, dt=0.03)


def run(solver: Solver, library: c.CDLL, steps: int) -> list[tuple[int, int, int]]:
    """Iterations with and, on a CPU, without, and nodes of T, of steps with a factor of the matrix of the first."""
    found = []
    for step in range(steps):
        ours, theirs = solver.solve(library)
        assert ours["status"] == 0 and ours["fallbacks"] == 0 and solver.error < 1e-5, step
        if step == 0:
            solver.post(solver.matrix, 0)
        else:
            found.append((int(ours["iterations"]), int(theirs["iterations"]), solver.used))
    return found


@pytest.mark.parametrize("blocks", [1, 3])
def test_look(library, monkeypatch, blocks):
    print(run(Solver(falling(), monkeypatch, blocks=blocks, refreshed=True), library, 12))
