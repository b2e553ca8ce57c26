# SPDX-License-Identifier: MIT
"""Factors of a GPU from before elements were removed (cut_nodes.cuh), beside the CPU's."""

import ctypes as c

import numpy as np
import pytest

from sim_server.simulation import Simulation
from tests.backends.pcg_on_threads import SOLVE, Solver, compiled, steps
from tests.cutting.cut_scenes import cut, made

SOLVER = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8, "max_iterations": 3000}
NOTCH, HALVED = "abs(X - 1) < 0.13 and Y > 0.25", "abs(X - 1) < 0.2"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("cuts"), SOLVE, "CUTS")


def bar() -> Simulation:
    return made(own={"corotational": {"young": 2e6, "poisson": 0.45}}, solver=SOLVER)


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
