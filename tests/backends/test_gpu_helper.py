# SPDX-License-Identifier: MIT
"""A second GPU that applies half of the inverses of large bodies, as far as it can be told without GPUs."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu import solver
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.support import nvrtc


@pytest.fixture(autouse=True)
def cupy(tmp_path, monkeypatch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    monkeypatch.setattr(solver, "LEAST_NODES", 10)
    with fake_cupy.installed(tmp_path, library, monkeypatch) as fake:
        fake.cuda.runtime.getDeviceCount = lambda: 2
        yield fake


def test_a_step_launches_the_helper_and_dismisses_it(cupy):
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.gpus=2"], "gpu")
    cupy.calls.clear()
    sim.engine.assemble()
    sim.engine.solve()
    names = [kernel for kernel, _ in cupy.calls]
    assert names.index("help") < names.index("pcg") < names.index("dismiss")
    body, engine = sim.world.bodies[0], sim.engine
    row_start, columns = sim.system.body_pattern(body.first, body.last)
    rows = np.repeat(np.arange(body.last - body.first), np.diff(row_start))
    values = np.where((rows == columns)[:, None, None], 50 * np.eye(3), -0.5 * np.eye(3))
    analysis = Analysis(row_start, columns)
    for step in (4, 5, 6):
        engine.post_factor(body.index, analysis.pattern, analysis.factorize(values, np.float32), step)
        engine.settle_factors()
        engine.run(1)
        row = engine.solver.bodies[body.index]
        assert row["helper"] > 0 and row["factor_step"] == step
    made = engine.solver.begin_plan(body.index, analysis.pattern).result()
    assert made.plan.plan.blocks == 2 * row["blocks"]
