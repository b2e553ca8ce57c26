# SPDX-License-Identifier: MIT
"""What bodies exert on grabs on a GPU: the spring's law, as on a CPU, in every step while something is held."""

import numpy as np
import pytest

from sim_server.backends.cpu.structs import REACTION_KINDS
from sim_server.simulation import Simulation
from tests.scenes import bar, scene

pytestmark = pytest.mark.gpu


def held_bar(device: str) -> Simulation:
    """Before anybody takes hold."""
    return Simulation(scene(bar(young=1e5, fixed="X < 0.01", touch=True), preconditioner="block_jacobi"), device)


def held(device: str) -> Simulation:
    sim = held_bar(device)
    touch = sim.touch
    assert touch is not None
    end = sim.fetch().x[:, 0].max()
    x = sim.world.x[sim.world.x[:, 0] > end - 1e-9].mean(axis=0)
    touch.grab(
        "anna", sim.world.bodies[0].name, tuple(x), 0.3, tuple(x + np.array([0.0, 0.1, 0.05])), 500.0, 1e4, np.inf
    )
    touch.grab("ben", sim.world.bodies[0].name, tuple(x), 0.3, tuple(x - np.array([0.0, 5.0, 0.0])), 500.0, 2.0, np.inf)
    return sim


def test_a_gpu_tells_the_forces_that_a_cpu_tells() -> None:
    found = {}
    for device in ("cpu", "gpu"):
        sim = held(device)
        sim.engine.run(40)
        assert len(sim.engine.records()) == 40
        found[device] = sim.engine.other_reactions()
        x, (anna, _) = sim.fetch().x, sim.touch.applied
        last = found[device][found[device]["number"] == anna.id][-1]
        pulls = anna.stiffness / len(anna.nodes) * (np.array(anna.target) + anna.offset - x[anna.nodes])
        np.testing.assert_allclose(-last["force"], pulls.sum(axis=0), atol=1e-9 * anna.stiffness)
        np.testing.assert_allclose(last["point"], (x[anna.nodes] - anna.offset).mean(axis=0), atol=1e-12)
    cpu, gpu = found["cpu"], found["gpu"]
    assert len(cpu) == 80 and (cpu["kind"] == REACTION_KINDS["ON_GRAB"]).all()
    for name in ("step", "number", "body", "kind"):
        assert (cpu[name] == gpu[name]).all()
    for name in ("force", "torque", "point"):
        np.testing.assert_allclose(gpu[name], cpu[name], atol=1e-4 * np.abs(cpu[name]).max() + 1e-12)


def test_nothing_is_told_before_and_after() -> None:
    sim = held_bar("gpu")
    sim.engine.run(40)
    sim.engine.records()
    assert len(sim.engine.other_reactions()) == 0
    touch = sim.touch
    assert touch is not None
    x = sim.fetch().x.mean(axis=0)
    grab = touch.grab("anna", sim.world.bodies[0].name, tuple(x), 0.3, tuple(x), 500.0, 1e4, np.inf)
    sim.engine.run(20)
    touch.release("anna", grab.id)
    sim.engine.run(20)
    sim.engine.records()
    assert set(sim.engine.other_reactions()["step"]) == set(range(41, 61))
    assert sim.engine.loop.others_dropped == 0
