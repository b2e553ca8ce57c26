# SPDX-License-Identifier: MIT
"""A body of which a thread block has more than fits into shared memory: rows of A pass through it in slabs, matrices of
the inverse come from memory each time. Few thread blocks make a small body large."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.gpu import solver_layout
from sim_server.backends.gpu.row_partition import assign_blocks
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.gpu.test_many_bodies import scene

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize(
    ("blocks", "overrides"),
    [
        (4, ["solver.factor_precision=float16"]),
        (7, ["solver.factor_precision=float16"]),
        (4, ["solver.factor_precision=float32"]),  # two planes
        (2, ["solver.precision=float32", "solver.tolerance=1e-4"]),
    ],
)
def test_as_on_the_cpu(blocks, overrides, tmp_path, monkeypatch):
    path = scene(tmp_path / "large.toml", [(5, 5, 20)])
    cpu = Simulation.load(path, [], "cpu")
    expected = Driver(cpu).advance(9)
    monkeypatch.setattr(solver_layout, "best_assignment", lambda nodes, *_: (assign_blocks(nodes, blocks), blocks))
    sim = Simulation.load(path, overrides, "gpu")
    found = Driver(sim).advance(9)
    assert sim.engine.solver.grid == blocks
    assert (found["status"] == SolveStatus.CONVERGED).all() and (found["factor_step"][4:] >= 0).all()
    assert (found["iterations"] <= expected["iterations"] + 2).all()
    error = np.abs(sim.fetch().x - cpu.fetch().x).max()
    assert error < (1e-5 if sim.scene.solver.precision == "float64" else 1e-3)
