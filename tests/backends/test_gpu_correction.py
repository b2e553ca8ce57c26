# SPDX-License-Identifier: MIT
"""Factors of a GPU, corrected for grabs and contacts that they do not know (correction_state.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest

from sim_server.effects import contact
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, STEP, ContactSolver, Solver, compiled
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


def off(solver: Solver) -> Solver:
    solver.correction.params["capacity"] = 0
    return solver


@pytest.mark.parametrize(
    ("stiffness", "radius", "near", "much"), [(1.0, 0.6, 0, 8), (100.0, 0.6, 400, 18), (1e4, 0.0, 400, 1)]
)
def test_grabs_are_corrected_as_on_a_cpu(library, monkeypatch, stiffness, radius, near, much):
    """Those that come and those that go, until a factor knows; near: M is made in memory of the inverse, or not."""
    solver, plain = Solver(grabbed(), monkeypatch, near), off(Solver(grabbed(), monkeypatch, near))
    found = []
    for each in (solver, plain):
        steps(each, library, 2, factor_at=0)
        assert each.used == 0
        held = hold(each.sim, stiffness, radius)
        found.append(steps(each, library, 3, factor_at=4))
        knows = steps(each, library, 1)
        each.sim.touch.release("anna", held)
        found.append(steps(each, library, 3, factor_at=8))
        print(found, knows, steps(each, library, 1), each.used)


def test_contacts(contact_library, monkeypatch):
    monkeypatch.setattr(contact, "nodes_alone", lambda world: True)
    solver = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8}
    for capacity in (32, 0):
        sim = over(cells=(3, 2, 3), at=(0, 0.006, 0), solver=solver)
        each = ContactSolver(sim, monkeypatch)
        each.correction.params["capacity"] = capacity
        for k in range(14):
            ours, theirs = each.solve(contact_library)
            print(k, ours["iterations"], theirs["iterations"], theirs["passes"], each.told[k % 4]["passes"], theirs["contacts"], theirs["kind"], each.used, each.error)
            if k in (0, 9): each.post(each.matrix, k)
