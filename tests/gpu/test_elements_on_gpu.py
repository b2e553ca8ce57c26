# SPDX-License-Identifier: MIT
"""Elements that do not lock, rollers and loads on surfaces, beside the CPU's. Runs where there is a GPU: -m gpu."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.gpu.test_assembly import stir

pytestmark = pytest.mark.gpu

BEAM = "deploy/scenes/beam.toml"
KINDS = ("patch", "smoothed", "quadratic")
WITH_FACTORS = ["solver.preconditioner=cholesky", "solver.update=lockstep-4", "solver.tolerance=1e-8"]
BOUND = {"float64": 1e-12, "mixed": 2e-5, "float32": 2e-4}  # of the largest entry
SCHEMES = {
    "backward Euler": [], "three linearizations": ["integrator.linearizations=3"],
    "newmark": ["integrator.scheme=newmark"], "ros2": ["integrator.scheme=ros2"],
}  # fmt: skip
HELD = [
    'object.beam.effects.fixed=[{where="Z < 0.01", along="z"}, {where="X < 0.01", along="x"}, '
    '{where="Y < 0.01", along="y"}]'
]
LOADS = {
    "force": '{where="Z > 3.99", force=[200.0, 0.0, 50.0]}',
    "pressure": '{where="Z > 3.99", pressure=2e3}',
    "moment": '{where="Z > 3.99", moment=[300.0, 0.0, 0.0]}',
}


def assembled(device: str, overrides: list[str]) -> Simulation:
    """A stirred beam after the first half of a step."""
    sim = Simulation.load(BEAM, overrides, device)
    stir(sim, 0.02)
    sim.engine.assemble()
    for name in ("values", "b_material", "y"):
        sim.world.backend.fetch(getattr(sim.system, name))
    return sim


def moved(device: str, overrides: list[str], steps: int = 20) -> tuple[Simulation, np.ndarray]:
    sim = Simulation.load(BEAM, overrides, device)
    records = Driver(sim).advance(steps)
    sim.fetch()
    return sim, records


@pytest.mark.parametrize("precision", BOUND)
@pytest.mark.parametrize("tangent", ["usual", "exact"])
@pytest.mark.parametrize("kind", KINDS)
def test_matrix_and_right_hand_side_are_the_cpus(kind, tangent, precision):
    keys = [f"object.beam.elements={kind}", f"object.beam.effects.corotational.tangent={tangent}"]
    found = assembled("gpu", [*keys, f"solver.precision={precision}"])
    expected = assembled("cpu", keys)
    for name in ("values", "b_material", "y"):
        a, b = getattr(found.system, name), getattr(expected.system, name)
        assert np.abs(a - b).max() <= BOUND[precision] * np.abs(b).max(), name
    A = found.matrix(0)
    assert abs(A - A.T).max() == 0, "symmetric to the last bit"


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("kind", KINDS)
def test_the_motion_is_the_cpus(kind, scheme):
    keys = [f"object.beam.elements={kind}", *WITH_FACTORS, *SCHEMES[scheme]]
    (gpu, g), (cpu, c) = moved("gpu", keys), moved("cpu", keys)
    assert (g["status"] == c["status"]).all()
    assert np.isin(g["status"], (SolveStatus.CONVERGED, SolveStatus.MAX_LINEARIZATIONS)).all()
    assert (g["iterations"] <= 2 * c["iterations"] + 4).all(), "factors of float16"
    assert np.abs(gpu.world.x - cpu.world.x).max() < 1e-5
    assert np.abs(cpu.world.x - cpu.world.rest).max() > 0.01, "it moved"


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bits_every_time(kind):
    """Without what goes by time: `auto` chooses by it, and asynchronous factors come when they come."""
    one, two = (moved("gpu", [f"object.beam.elements={kind}", *WITH_FACTORS])[0] for _ in range(2))
    assert np.array_equal(one.world.x, two.world.x)


@pytest.mark.parametrize("load", LOADS)
@pytest.mark.parametrize("kind", ["linear", "smoothed"])
def test_rollers_and_loads_are_the_cpus(kind, load):
    keys = [f"object.beam.elements={kind}", *HELD, f"object.beam.effects.traction={LOADS[load]}"]
    keys += ["effects.gravity.g=[0, -1, 0]", *WITH_FACTORS]
    (gpu, g), (cpu, _) = moved("gpu", keys), moved("cpu", keys)
    assert (g["status"] == SolveStatus.CONVERGED).all()
    assert np.abs(gpu.world.x - cpu.world.x).max() < 1e-6
    for axis, where in ((2, "z"), (0, "x"), (1, "y")):
        kept = gpu.world.rest[:, axis] < 0.01
        assert kept.any() and (gpu.world.x[kept, axis] == gpu.world.rest[kept, axis]).all(), where
    assert np.abs(cpu.world.x - cpu.world.rest).max() > 1e-3, "it moved"
