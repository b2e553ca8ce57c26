# SPDX-License-Identifier: MIT
"""Hyperelastic bodies on a GPU step by step beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.gpu.test_assembly import CASES
from tests.physics.laws import determinants

pytestmark = pytest.mark.gpu

LAWS = [case for case, (_, overrides, size) in CASES.items() if size <= 0.05 and "projection" in " ".join(overrides)]
TIGHT = ["solver.preconditioner=block_jacobi", "solver.tolerance=1e-10", "solver.max_iterations=3000"]
SMALL = ["object.beam.mesh.bar=[3, 3, 8]", "object.beam.mesh.size=[1, 1, 3]"]


def loaded(case: str, device: str) -> Simulation:
    return Simulation.load("deploy/scenes/beam.toml", [*CASES[case][1], *TIGHT, *SMALL], device)


@pytest.mark.parametrize("case", [*LAWS, "fibres beside"])
def test_steps_are_the_cpus(case):
    """A beam that falls and bends under its weight; every step is compared."""
    on_gpu, on_cpu = loaded(case, "gpu"), loaded(case, "cpu")
    gpu, cpu = Driver(on_gpu), Driver(on_cpu)
    moved = 0.0
    for _ in range(25):
        g, c = gpu.advance(1), cpu.advance(1)
        assert g["status"][0] == c["status"][0] == SolveStatus.CONVERGED
        x = on_gpu.fetch().x
        moved = max(moved, float(np.abs(on_cpu.world.x - on_cpu.world.rest).max()))
        assert np.abs(x - on_cpu.world.x).max() < 1e-7
    assert moved > 1e-3
    assert on_gpu.potential_energy() == pytest.approx(on_cpu.potential_energy(), rel=1e-6)


@pytest.mark.parametrize("case", ["neo_hookean", "ogden", "costa", "mooney_rivlin"])
def test_refused_elements_are_the_cpus(case):
    """One node pushed through the body: the same elements, the same J, and the run goes on."""
    found, rested = [], []
    for device in ("gpu", "cpu"):
        sim = loaded(case, device)
        Driver(sim).advance(2)
        sim.fetch()
        node = int(np.argmax(sim.world.x @ [1, 1, 1] * sim.world.free))
        sim.world.x[node] -= 0.9
        if device == "gpu":
            twin = sim.world.backend.twin(sim.world.x)
            twin.set(sim.world.x)
        bad = int((determinants(sim) <= 0).sum())
        records = Driver(sim).advance(2)
        assert (records["status"] == SolveStatus.NOT_FINITE).all()
        refused = sim.refusals()
        assert bad > 0 and len({r.element for r in refused}) == len(refused) >= bad
        found.append([(r.element, r.J, r.time) for r in refused])
        assert np.isfinite(sim.fetch().x).all() and not sim.world.v.any()
        rested.append(sim.world.x.copy())
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-9)
    assert np.abs(rested[0] - rested[1]).max() < 1e-7, "a step back"
