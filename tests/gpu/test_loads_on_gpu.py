# SPDX-License-Identifier: MIT
"""Loads and actuation, beside the CPU's. Runs where there is a GPU: -m gpu."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import INSIDE, hollow
from tests.gpu.test_assembly import stir
from tests.scenes import scene

pytestmark = pytest.mark.gpu
PATH = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 1, 1]]
LOADS: dict[str, Any] = {
    "buoyancy": {"level": 0.3},
    "cable": [{"path": PATH, "tension": 90.0}, {"path": PATH[::2], "stiffness": 1e4, "shortening": 0.1}],
    "cavity": [
        {"where": INSIDE, "pressure": 900.0}, {"where": f"{INSIDE} and X > 0.3", "pressure": 300.0, "lids": True},
    ],
    "growth": {"expansion": [0.01, 0.02, 0]},
    "membrane": {"young": 1e6, "poisson": 0.4, "thickness": 0.01, "prestretch": 1.1, "density": 1000.0},
    "muscle": {"stress": 1e4, "direction": [1, 2, 0], "period": 0.3, "width": 0.8},
    "rod": [
        {"path": [[0.1, 0.1, 0.1], [0.9, 0.1, 0.15]], "young": 1e8, "radius": 0.01, "density": 7850.0},
        {"path": [[0.1, 0.9, 0.1], [0.9, 0.9, 0.1], [0.9, 0.9, 0.9]], "young": 1e8, "radius": 0.01, "prestretch": 1.1},
    ],
    "target": {"to": ["X", "Y + 0.1 * X", "Z"], "stiffness": 1e3},
    "traction": {"where": "X > 0.99", "pressure": 200.0},
    "wind": {"velocity": [5, 1, 0], "density": 100.0, "friction": 0.1},
}  # fmt: skip
BOUND = {"float64": 1e-11, "mixed": 5e-5, "float32": 5e-4}  # of the largest entry
SCHEMES: dict[str, dict[str, Any]] = {
    "backward Euler": {}, "three linearizations": {"linearizations": 3}, "newmark": {"scheme": "newmark"},
    "ros2, iterations": {"scheme": "ros2", "solve": "iterate"}, "ros2": {"scheme": "ros2"},
    "substeps": {"scheme": "central_difference"},
}  # fmt: skip


def made(folder: Path, names: Any, device: str, integrator: Any = None, dt: float = 0.02, **solver: Any) -> Simulation:
    loads = {name: LOADS[name] for name in names}
    given = hollow(folder, loads.pop("cavity", None), fixed={"where": "X < 0.01"}, **loads)
    return Simulation(scene(given, gravity=(0, -9.81, 0), integrator=integrator, dt=dt, **solver), device)


@pytest.mark.parametrize("precision", BOUND)
@pytest.mark.parametrize("name", [*LOADS, "all"])
def test_matrix_and_forces_are_the_cpus(tmp_path, name, precision):
    names = list(LOADS) if name == "all" else [name]
    sims = []
    for device, given in (("gpu", precision), ("cpu", "float64")):
        sim = made(tmp_path, names, device, precision=given)
        stir(sim, 0.02)
        sim.engine.assemble()
        for array in (sim.system.values, sim.system.b_material, sim.world.load):
            if array.size:
                sim.world.backend.fetch(array)
        sims.append(sim)
    found, expected = sims
    for a, b in (
        (found.system.values, expected.system.values), (found.system.b_material, expected.system.b_material),
        (found.world.load, expected.world.load),
    ):  # fmt: skip
        assert a.shape == b.shape
        assert not b.size or np.abs(a - b).max() <= BOUND[precision] * np.abs(b).max()


@pytest.mark.parametrize("scheme", [name for name in SCHEMES if name != "substeps"])
def test_a_body_with_all_loads_moves_as_on_the_cpu(tmp_path, scheme):
    ends = []
    for device in ("gpu", "cpu"):
        sim = made(tmp_path, LOADS, device, SCHEMES[scheme], tolerance=1e-10)
        driver = Driver(sim)
        records = driver.advance(20)
        assert set(records["status"].tolist()) <= {SolveStatus.CONVERGED, SolveStatus.MAX_LINEARIZATIONS}
        ends.append((sim.fetch().x.copy(), records["work"][-1], driver.readings))
    bound = 1e-3 if scheme == "ros2" else 1e-6  # a rod of steel is as exact there as the device's factor
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=bound)
    assert ends[0][1] == pytest.approx(ends[1][1], rel=100 * bound)
    assert ends[0][2].shape == (20, 8)
    np.testing.assert_allclose(ends[0][2], ends[1][2], rtol=100 * bound, atol=1e-9)


def test_explicit_substeps_with_all_loads_are_those_of_the_cpu(tmp_path):
    """A GPU makes four in a step here, a CPU one in each of four steps. The activation of a muscle is that of the
    step."""
    ends = []
    for device, dt, steps in (("gpu", 0.02, 20), ("cpu", 0.005, 80)):
        sim = made(tmp_path, LOADS, device, SCHEMES["substeps"], dt)
        records = Driver(sim).advance(steps)
        assert set(records["status"].tolist()) == {SolveStatus.CONVERGED}
        ends.append((sim.fetch().x.copy(), records["substeps"][0]))
    assert (ends[0][1], ends[1][1]) == (4, 1)
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-3)
