# SPDX-License-Identifier: MIT
"""Factors of a GPU, corrected for grabs and contacts that they do not know (correction_state.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest

from sim_server.backends.gpu.correction import CORRECTED_BODY
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, STEP, ContactSolver, Solver, compiled, steps
from tests.contact.scenes import over
from tests.scenes import bar, simulation

END = np.array([2.0, 1.0, 0.5])


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("solver"), SOLVE)


@pytest.fixture(scope="module")
def contact_library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("contact_solver"), STEP, "CONTACT_PASSES")


def grabbed(woodbury: int = 32) -> Simulation:
    beam = bar((4, 2, 2), young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    return simulation(
        beam, gravity=(0, -9.81, 0), preconditioner="cholesky", update="never", tolerance=1e-8, woodbury=woodbury
    )


def hold(sim: Simulation, stiffness: float, radius: float) -> int:
    """Grabs nodes at the end with springs of so many of their own blocks each; returns the number of the grab."""
    w, s = sim.world, sim.system
    block = float((s.diagonal + s.block[:, [0, 3, 5]].sum(axis=1) / 3)[-1])
    nodes = max(1, int((np.linalg.norm(w.x - END, axis=1) <= radius).sum()))
    at, to = (2.0, 1.0, 0.5), (2.0, 1.1, 0.5)
    return sim.touch.grab("anna", "bar", at, radius, to, nodes * stiffness * block / w.dt**2, 0.0, np.inf).id


def uncorrected(solver: Solver) -> Solver:
    solver.correction.params["capacity"] = 0
    return solver


def test_nodes_that_are_held_fast_are_corrected_as_on_a_cpu(library, monkeypatch):
    """A hand takes hold, and lets go again, both after the matrix of the factor. Thread blocks exchange values."""
    solver, plain = Solver(grabbed(), monkeypatch, blocks=3), uncorrected(Solver(grabbed(), monkeypatch))
    found: list[list[tuple[int, int]]] = []
    for each in (solver, plain):
        steps(each, library, 2, factor_at=0)
        assert each.used == 0
        held = hold(each.sim, 100.0, 0.6)
        found.append(steps(each, library, 1, factor_at=2))
        each.sim.touch.release("anna", held)
        found.append(steps(each, library, 1))
    ((came, on_cpu),), ((gone, gone_on_cpu),), ((stale, _),), ((stale_gone, _),) = found
    assert solver.used == 5 and plain.used == 0
    assert came <= on_cpu + 2 and gone <= gone_on_cpu + 4, "a part of what has gone remains"
    assert stale > 20 and stale_gone > 4 * gone


def test_a_factor_that_knows_the_grab_is_not_corrected(library, monkeypatch):
    """near: M is made in memory of the inverse, which is fetched again."""
    solver = Solver(grabbed(), monkeypatch, near=40)
    steps(solver, library, 1, factor_at=0)
    hold(solver.sim, 1e4, 0.0)
    ((ours, theirs),) = steps(solver, library, 1, factor_at=1)
    assert solver.used == 1 and ours <= theirs + 3
    ((ours, theirs),) = steps(solver, library, 1)
    made = solver.correction.bodies.view(CORRECTED_BODY)
    assert abs(ours - theirs) <= 1 and made["step"][0] == 0, "its columns are those of the factor before"


def test_more_nodes_than_allowed_and_weak_springs_are_left_to_the_iteration(library, monkeypatch):
    for stiffness, woodbury in ((100.0, 4), (0.05, 32)):
        solver = Solver(grabbed(woodbury), monkeypatch)
        steps(solver, library, 1, factor_at=0)
        hold(solver.sim, stiffness, 0.6)
        steps(solver, library, 1)
        assert solver.used == 0


def test_contacts_that_came_are_corrected(contact_library, monkeypatch):
    """A block with a factor without contacts falls onto a floor."""
    options = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8, "max_iterations": 5000}
    iterations = {}
    for capacity in (32, 0):
        solver = ContactSolver(over(cells=(3, 2, 3), at=(0, 0.006, 0), solver=options), monkeypatch)
        solver.correction.params["capacity"] = capacity
        records = []
        for step in range(4):
            records.append(solver.solve(contact_library))
            assert records[-1][0]["status"] == 0 and solver.error < 1e-7
            if step == 0:
                solver.post(solver.matrix, 0)
        assert solver.used == (16 if capacity else 0) and records[-1][1]["contacts"] == 16
        iterations[capacity] = [int(ours["iterations"]) for ours, _ in records[1:]]
    assert max(iterations[32]) <= 10 and min(iterations[0]) > 4 * max(iterations[32])


def test_what_a_factor_knows_of_contacts_is_not_corrected(contact_library, monkeypatch):
    options = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8}
    solver = ContactSolver(over(cells=(2, 1, 2), solver=options), monkeypatch)
    for step in range(5):
        ours, _ = solver.solve(contact_library)
        if step == 3:
            solver.post(solver.matrix, 3)
    assert ours["iterations"] <= 4 and solver.used == 0
