# SPDX-License-Identifier: MIT
"""Two GPUs of a host for one scene: the second applies half of the inverses of large bodies."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.gpu import helper, solver_layout
from sim_server.backends.gpu.row_partition import assign_blocks
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import over
from tests.cutting.cut_scenes import cut
from tests.gpu.test_correction_on_gpu import CELLS, held
from tests.gpu.test_cuts_on_gpu import NOTCH, made
from tests.gpu.test_many_bodies import scene

pytestmark = pytest.mark.gpu


@pytest.fixture(autouse=True)
def two_gpus(monkeypatch):
    from sim_server.backends.gpu.device import cupy

    if cupy().cuda.runtime.getDeviceCount() < 2:
        pytest.skip("needs two GPUs")
    monkeypatch.setattr(helper, "LEAST_NODES", 10)


def run(path, steps, *overrides):
    sim = Simulation.load(path, ["solver.gpus=2", *overrides], "gpu")
    return sim, Driver(sim).advance(steps)


@pytest.mark.parametrize(
    "overrides",
    [
        ["solver.factor_precision=float16"],
        ["solver.factor_precision=float32"],  # two planes
        ["solver.precision=float32", "solver.tolerance=1e-4"],
        ["integrator.linearizations=3", "integrator.tolerance=1e-3"],
        ["accuracy.position=1e-5"],
    ],
)
@pytest.mark.parametrize("blocks", [None, 4])  # few thread blocks: several parts each, and several phases
def test_as_on_the_cpu(blocks, overrides, tmp_path, monkeypatch):
    path = scene(tmp_path / "large.toml", [(5, 5, 20)])
    single = [each for each in overrides if "precision" not in each]
    cpu = Simulation.load(path, single, "cpu")
    expected = Driver(cpu).advance(9)
    if blocks:
        monkeypatch.setattr(solver_layout, "best_assignment", lambda nodes, *_: (assign_blocks(nodes, blocks), blocks))
    sim, found = run(path, 9, *overrides)
    row = sim.engine.solver.bodies[0]
    assert row["helper"] > 0 and (found["status"] == SolveStatus.CONVERGED).all()
    assert (found["factor_step"][4:] >= 0).all() and (found["iterations"] <= expected["iterations"] + 2).all()
    error = np.abs(sim.fetch().x - cpu.fetch().x).max()
    assert error < (1e-5 if sim.scene.solver.precision == "float64" else 1e-3)


def test_runs_repeat_to_the_bit(tmp_path):
    path = scene(tmp_path / "two.toml", [(5, 5, 20), (4, 4, 12), (1, 1, 1)])
    first, records = run(path, 12)
    again, others = run(path, 12)
    assert (first.engine.solver.bodies["helper"] > 0).tolist() == [True, True, False]
    assert (first.fetch().x == again.fetch().x).all() and (records["iterations"] == others["iterations"]).all()
    alone = Simulation.load(path, [], "gpu")
    Driver(alone).advance(12)
    assert np.abs(first.fetch().x - alone.fetch().x).max() < 1e-6


@pytest.mark.parametrize("woodbury", [32, 0])
def test_a_grab_that_a_factor_does_not_know(woodbury):
    (two, x), (one, alone) = (held(CELLS["larger"], "gpu", gpus=gpus, woodbury=woodbury) for gpus in (2, 1))
    assert np.abs(x - alone).max() < 1e-6
    for found, expected in zip(two, one, strict=True):
        assert (found["status"] == SolveStatus.CONVERGED).all()
        assert found["fallbacks"].sum() <= expected["fallbacks"].sum()
        assert (found["iterations"] <= 1.2 * expected["iterations"] + 3).all()


def test_passes_of_contact_with_a_floor():
    ends = []
    for gpus in (2, 1):
        options = {"preconditioner": "cholesky", "update": "lockstep-3", "tolerance": 1e-8, "gpus": gpus}
        sim = over(cells=(6, 4, 6), at=(0, 0.006, 0), solver=options, device="gpu")
        records = Driver(sim).advance(15)
        assert (records["status"] == SolveStatus.CONVERGED).all() and records["contacts"].max() > 0
        assert (records["factor_step"][6:] > 0).all()
        ends.append(sim.fetch().x.copy())
    assert np.abs(ends[0] - ends[1]).max() < 1e-6


def test_a_body_that_loses_elements():
    ends = []
    for gpus in (2, 1):
        solver = {"update": "lockstep-6", "tolerance": 1e-8, "preconditioner": "cholesky", "max_iterations": 3000}
        sim = made("corotational", "gpu", solver=solver | {"gpus": gpus})
        driver = Driver(sim)
        driver.step_with_fresh_factors()
        driver.advance(3)
        cut(sim, NOTCH)
        assert (driver.advance(10)["status"] == SolveStatus.CONVERGED).all()
        ends.append(sim.fetch().x.copy())
    assert np.abs(ends[0] - ends[1]).max() < 1e-6


def test_small_bodies_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(helper, "LEAST_NODES", 10_000)
    with pytest.raises(Exception, match=r"solver.gpus = 2: the largest object has .* nodes"):
        run(scene(tmp_path / "small.toml", [(2, 2, 4)]), 1)
