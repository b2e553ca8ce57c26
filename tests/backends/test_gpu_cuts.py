# SPDX-License-Identifier: MIT
"""Factors of a GPU from before elements were removed or a body was split (cut_nodes.cuh), beside the CPU's."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.followed_rows import siblings
from sim_server.backends.gpu.splits import SPLIT_NOTES
from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, Solver, compiled
from tests.cutting.cut_scenes import cut, made
from tests.cutting.split_scenes import HALVES, SLIT, split

NOTE = """
#include "note_splits.cu"
extern "C" void note(const SplitNotes* p) { launch(1, THREADS, [&] { note_splits(*p); }); }
"""
SOLVER = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8, "max_iterations": 3000}
JACOBI = 119  # iterations of block Jacobi after a slit
NOTCH, HALVED = "abs(X - 1) < 0.13 and Y > 0.25", "abs(X - 1) < 0.2"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("cuts"), SOLVE, "CUTS")


@pytest.fixture(scope="module")
def split_library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("splits"), SOLVE + NOTE, "CUTS", "SPLITS")


def bar(spare: int = 0, **keys: Any) -> Simulation:
    own = {"corotational": {"young": 2e6, "poisson": 0.45}, "cutting": {"spare": spare} if spare else True}
    return made(own=own, solver=SOLVER | keys)


class SplitSolver(Solver):
    """Follows splits as backends/gpu/splits.py does."""

    def __init__(self, sim: Simulation, monkeypatch: pytest.MonkeyPatch, **keys: Any):
        super().__init__(sim, monkeypatch, **keys)
        own = self.solver.split_memory
        self.memory = own | {"number": np.zeros(1, np.int64), "noted": np.zeros(1, np.int64),
                             "origin_noted": own["origin"].copy(), "step": self.counter}  # fmt: skip
        self.notes = np.zeros((), SPLIT_NOTES)
        self.notes["bodies"], self.notes["nodes"] = 1, sim.world.nodes
        for name, array in self.memory.items():
            self.notes[name] = array.ctypes.data

    def open(self, library: c.CDLL, where: str) -> int:
        """Splits the body; returns the copies that it then has."""
        used = split(self.sim, where).used
        self.sim.engine.take_changes()
        pattern = self.sim.system.row_start, self.sim.system.columns
        for array, contents in self.solver.follow(*pattern, self.sim.cutting.origin):
            array[...] = contents
        self.renew()
        self.memory["number"] += 1
        library.note(c.c_void_p(self.notes.ctypes.data))
        return used


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


@pytest.mark.parametrize("where", [NOTCH, HALVED])
@pytest.mark.parametrize("blocks", [1, 3])
def test_nodes_without_elements_are_set_apart(library, monkeypatch, where, blocks):
    found = {}
    for apart in (True, False):
        solver = Solver(bar(), monkeypatch, blocks=blocks)
        steps(solver, library, 3, factor_at=2)
        cut(solver.sim, where)
        solver.sim.engine.take_changes()
        nowhere = np.zeros(solver.sim.world.nodes)
        if not apart:
            solver.solver.params["at_rest"] = nowhere.ctypes.data
        ((found[apart], corrected),) = steps(solver, library, 1)
        assert (solver.sim.cutting.at_rest > 0).any() and corrected <= found[apart]
    assert 1.5 * found[True] < found[False]


@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("where", [SLIT, HALVES])
def test_a_factor_from_before_a_split_stays_in_use(split_library, monkeypatch, where, blocks):
    solver = SplitSolver(bar(spare=60), monkeypatch, blocks=blocks)
    steps(solver, split_library, 3, factor_at=2)
    ((fresh, _),) = steps(solver, split_library, 1)
    assert solver.open(split_library, where) > 0
    ((after, _),) = steps(solver, split_library, 1)
    rows = solver.solver.bodies
    rows["plan"], plan = 0, rows["plan"].copy()
    ((jacobi, _),) = steps(solver, split_library, 1)
    rows["plan"] = plan
    assert fresh <= after < 0.7 * jacobi
    solver.post(solver.matrix, int(solver.counter[0]))
    ((again, _),) = steps(solver, split_library, 1)
    assert again <= fresh + 1, "a factor that knows of the split"


def test_copies_of_copies_move_as_what_the_factor_knows(split_library, monkeypatch):
    """A factor from between two splits, too."""
    solver = SplitSolver(bar(spare=120), monkeypatch, blocks=2)
    steps(solver, split_library, 2, factor_at=1)
    first = solver.open(split_library, SLIT)
    steps(solver, split_library, 2)
    second = solver.open(split_library, "X > 1 and Y > 0.25 and Z > 0.25")
    assert second > first
    sim = solver.sim
    assert (sim.cutting.origin[sim.cutting.origin[sim.cutting.origin >= 0]] >= 0).all()
    ((old, _),) = steps(solver, split_library, 1)
    solver.post(solver.matrix, int(solver.counter[0]) - 1)
    ((new, _),) = steps(solver, split_library, 1)
    assert new <= 5 and old < 0.9 * JACOBI


def test_siblings_are_the_copies_of_a_node_of_the_mesh_in_their_order():
    origin = np.array([0, 1, 2, 1, 3, 0, 1, -1], np.int32)
    np.testing.assert_array_equal(siblings(origin), [5, 3, -1, 4, 6, -1, -1, -1])
