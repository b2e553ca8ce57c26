# SPDX-License-Identifier: MIT
"""Several effects with loads in one scene: their forces add up, and so does their work; a chamber of gas in contact."""

from typing import Any

import numpy as np
import pytest

from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.worker_assembly import Assembly
from tests.effects.hollow import INSIDE, hollow
from tests.scenes import scene

G = (0.0, -9.81, 0.0)
LOADS: dict[str, dict[str, Any]] = {
    "buoyancy": {"level": 0.3},
    "cable": {"path": [[0, 0, 0], [0.5, 0, 0], [1, 1, 1]], "tension": 50.0},
    "cavity": {"where": INSIDE, "pressure": 300.0},
    "muscle": {"stress": 2e3, "direction": [1, 1, 0]},
    "traction": {"where": "Y > 0.99", "force": [10, 20, 30], "pressure": 40.0},
    "wind": {"velocity": [5, 1, 0], "density": 20.0},
}


def made(
    folder: Any, loads: dict[str, Any], integrator: dict | None = None, dt: float = 0.02, **more: Any
) -> Simulation:
    others = {name: table for name, table in loads.items() if name != "cavity"}
    given = hollow(folder, loads.get("cavity"), **others)
    return Simulation(scene(given, integrator=integrator, dt=dt, gravity=G, **more))


def load(sim: Simulation) -> np.ndarray:
    random = np.random.default_rng(0)
    sim.world.x[:] += 0.02 * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.x.shape)
    sim.engine.assemble()
    return np.asarray(sim.world.load.copy())


def test_loads_add_up(tmp_path):
    each = [load(made(tmp_path, {name: table})) for name, table in LOADS.items()]
    assert min(np.abs(one).max() for one in each) > 0.1
    np.testing.assert_allclose(load(made(tmp_path, LOADS)), sum(each), atol=1e-9)


@pytest.mark.parametrize("scheme", ["ros2", "central_difference"])
def test_the_balance_of_energy_closes(tmp_path, scheme):
    """Kinetic and elastic energy, of the gas, too, are those of the start, the work of all loads and of gravity."""
    loads = LOADS | {
        "cavity": {"where": INSIDE, "amount": 1.02}, "target": {"to": ["X", "Y", "1.1 * Z"], "stiffness": 1e4},
        "growth": {"expansion": 0.02}, "muscle": LOADS["muscle"] | {"period": 0.2},
    }  # fmt: skip
    integrator = {"scheme": scheme} | ({"solve": "iterate"} if scheme == "ros2" else {})
    sim = made(tmp_path, loads, integrator, 0.002, **({"tolerance": 1e-10} if scheme == "ros2" else {}))
    potential = [e for name, e in sim.effects.items() if name != "gravity"]
    start, rest = sum(e.energy() for e in potential), sim.world.x.copy()
    records = Driver(sim).advance(100)
    fallen = G[1] * sim.world.mass @ (sim.fetch().x - rest)[:, 1]
    energy = sim.kinetic_energy() + sum(e.energy() for e in potential)
    assert (records["status"] == 0).all() and start > 10 and abs(records["work"][-1]) > 10
    assert energy == pytest.approx(start + records["work"][-1] + fallen, rel=0.03)


def test_a_box_of_gas_falls_on_a_floor(tmp_path):
    """What presses on it squeezes the gas, whose law holds; the solves of bodies in contact know it."""
    given = hollow(tmp_path, {"where": INSIDE, "amount": 1.0, "ambient": 2e4})
    given["effects"]["corotational"]["young"] = 3e4
    table = {
        "name": "floor", "dt": 0.01, "object": [given], "solver": {"tolerance": 1e-8},
        "effects": {"gravity": {"g": list(G)}, "contact": True},
        "obstacle": [{"name": "floor", "shape": "plane", "pose": {"translate": [0, -0.02, 0]}}],
    }  # fmt: skip
    sim = Simulation(Scene.model_validate(table, context={"folder": "."}))
    records = Driver(sim).advance(120)
    assert (records["status"] == 0).all()
    sim.fetch()
    sim.engine.assemble()
    found = sim.effects["cavity"].readings()[0]  # type: ignore[attr-defined]
    assert found.pressure > 100 and (found.pressure + 2e4) * found.volume == pytest.approx(2e4 * 0.125, rel=1e-9)
    assert sim.world.x[:, 1].min() > -0.05 and np.abs(sim.world.v).max() < 1


def test_a_worker_assembles_the_same_matrix(tmp_path):
    """Of what follows from positions; it is not asked where drag or a beat is in it, which it cannot know."""
    loads = {name: table for name, table in LOADS.items() if name != "wind"} | {
        "cable": [LOADS["cable"], {"path": [[0, 1, 0], [0.5, 1, 1], [1, 0, 1]], "stiffness": 1e4, "shortening": 0.1}],
        "target": {"to": ["X", "Y", "1.1 * Z"], "stiffness": 1e4}, "growth": {"expansion": 0.02},
    }  # fmt: skip
    sim = made(tmp_path, loads)
    sim.world.x[:] += 0.02 * np.random.default_rng(0).normal(size=sim.world.x.shape)
    sim.engine.assemble()
    assert all(e.known_to_workers for e in sim.effects.values())
    worker = Assembly(messages.scene(sim), messages.topology(sim, sim.world.bodies[0]))
    assert worker.matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()
    for unknown in ({"wind": LOADS["wind"]}, {"muscle": LOADS["muscle"] | {"period": 0.3}}):
        assert not all(e.known_to_workers for e in made(tmp_path, unknown).effects.values())
