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


@pytest.mark.parametrize(("blocks", "near"), [(1, 0), (3, 0), (3, 40)])
def test_a_slow_solve_goes_on_with_an_exact_one_where_the_body_has_changed_most(library, monkeypatch, blocks, near):
    """Those that follow with the same factor begin with it. near: S is made in memory of the inverse."""
    found = run(Solver(falling(), monkeypatch, near=near, blocks=blocks, refreshed=True), library, 11)
    used = [nodes for *_, nodes in found]
    first = next(k for k, nodes in enumerate(used) if nodes)
    assert 0 < first < len(used) - 1 and all(0 < nodes <= MOST for nodes in used[first:])
    assert all(abs(ours - theirs) <= 1 for ours, theirs, nodes in found if not nodes), "nothing changes without"
    assert all(ours < 0.8 * theirs for ours, theirs, _ in found[first + 1 :]), found


def test_a_new_factor_is_enough_again(library, monkeypatch):
    solver = Solver(falling(), monkeypatch, refreshed=True)
    assert run(solver, library, 11)[-1][2] > 0
    solver.post(solver.matrix, 10)
    ours, theirs = solver.solve(library)
    assert solver.used == 0 and abs(int(ours["iterations"]) - int(theirs["iterations"])) <= 1


@pytest.mark.parametrize("forgotten", ["the matrix", "the step"])
def test_a_factor_whose_matrix_is_not_known_stays_as_it_is(library, monkeypatch, forgotten):
    solver = Solver(falling(), monkeypatch, refreshed=True)
    if forgotten == "the step":
        solver.refresh.params["kept"] = 4
    run(solver, library, 6)
    if forgotten == "the matrix":
        solver.refresh._memory["noted"][...] = -1
    for _ in range(5):
        ours, theirs = solver.solve(library)
        assert solver.used == 0 and abs(int(ours["iterations"]) - int(theirs["iterations"])) <= 1


def test_more_nodes_than_there_is_room_for_are_fewer_that_changed_more(library, monkeypatch):
    """Levels of change are raised until few enough nodes are above; the scores of all are told here."""
    solver = Solver(falling(), monkeypatch, refreshed=True)
    run(solver, library, 11)
    score = np.asarray(solver.refresh._memory["score"])
    assert solver.used == (score > REFRESH.constant("CHANGED")).sum() < MOST
