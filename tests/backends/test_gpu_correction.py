# SPDX-License-Identifier: MIT
"""Factors of a GPU, corrected for grabs and contacts that they do not know (correction_state.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import Solver, compiled
from tests.scenes import bar, simulation

SOLVE = """
#include "pcg.cu"
extern "C" void solve(const PcgArguments* s, const Correction* k) {
    *s->pool_counter = 0;
    launch(s->grid, THREADS, [&] { pcg(*s, *k); });
}
"""
END = np.array([2.0, 1.0, 0.5])


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("solver"), SOLVE)


def grabbed(woodbury: int = 32) -> Simulation:
    beam = bar((4, 2, 2), young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    return simulation(beam, gravity=(0, -9.81, 0), preconditioner="cholesky", update="never", tolerance=1e-8, woodbury=woodbury)


def hold(sim: Simulation, stiffness: float, radius: float) -> int:
    """Grabs nodes at the end with springs of so many of their own blocks each; returns the number of the grab."""
    w, s = sim.world, sim.system
    block = float((s.diagonal + s.block[:, [0, 3, 5]].sum(axis=1) / 3)[-1])
    nodes = max(1, int((np.linalg.norm(w.x - END, axis=1) <= radius).sum()))
    at, to = (2.0, 1.0, 0.5), (2.0, 1.1, 0.5)
    return sim.touch.grab("anna", "bar", at, radius, to, nodes * stiffness * block / w.dt**2, 0.0, np.inf).id


def steps(solver: Solver, library: c.CDLL, count: int, factor_at: int = -1) -> list[tuple[int, int]]:
    """Iterations of steps on a GPU and a CPU. factor_at: step after which both have a factor of its matrix."""
    found = []
    for _ in range(count):
        step = int(solver.counter[0])
        ours, theirs = solver.solve(library)
        assert ours["status"] == 0 and ours["fallbacks"] == 0 and solver.error < 1e-4
        found.append((int(ours["iterations"]), int(theirs["iterations"])))
        if step == factor_at:
            solver.post(solver.matrix, step)
    return found


@pytest.mark.parametrize(("stiffness", "radius", "near"), [(1.0, 0.6, 0), (100.0, 0.6, 40), (1e4, 0.0, 40)])
def test_grabs_are_corrected_as_on_a_cpu(library, monkeypatch, stiffness, radius, near):
    solver = Solver(grabbed(), monkeypatch, near)
    plain = Solver(grabbed(), monkeypatch, near, woodbury=1)
    for each in (solver, plain):
        steps(each, library, 2, factor_at=0)
        assert each.used == 0
        hold(each.sim, stiffness, radius)
    (with_it, without) = steps(solver, library, 3), steps(plain, library, 3)
    print(with_it, without)
