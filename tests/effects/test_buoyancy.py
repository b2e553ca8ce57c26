# SPDX-License-Identifier: MIT
"""Buoyancy: Archimedes in any pose and depth, floating at the right depth, squeezing, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import TUBE, box, hollow
from tests.scenes import bar, rotation, scene

G = (0.0, -9.81, 0.0)


def floating(
    buoyancy: Any, integrator: dict | None = None, gravity: Any = G, dt: float = 0.02, **table: Any
) -> Simulation:
    """A bar of 2 x 1 x 1 m."""
    solver = table.pop("solver", {})
    given = bar(**({"density": 500} | table))
    given["effects"]["buoyancy"] = buoyancy
    return Simulation(scene(given, integrator=integrator, dt=dt, gravity=gravity, **solver))


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["buoyancy"].load.copy())  # type: ignore[attr-defined]


@pytest.mark.parametrize("level", [-0.2, 0.3, 0.5, 0.77, 1.0, 1.4])
def test_the_force_is_the_weight_of_what_is_displaced(level):
    """And its line goes through the centroid of that volume."""
    sim = floating({"level": level, "density": 800.0})
    depth = min(max(level, 0.0), 1.0)
    lift = 800 * 9.81 * 2 * depth
    force = forces(sim)
    np.testing.assert_allclose(force.sum(axis=0), [0, lift, 0], atol=1e-9)
    torque = np.cross(sim.world.x, force).sum(axis=0)
    np.testing.assert_allclose(torque, np.cross([1, depth / 2, 0.5], [0, lift, 0]), atol=1e-9)


@pytest.mark.parametrize("angle", [0.9, 1.6, 2.0])
def test_archimedes_in_any_pose(angle):
    """The volume below the level, by points inside; gravity along another axis, too."""
    turn, g = rotation([1, 2, 3], angle), np.array([3.0, -1.0, 9.0])
    sim = floating({"level": 0.1}, gravity=tuple(g), cells=(2, 1, 1))
    sim.world.x[:] = sim.world.rest @ turn.T
    up = -g / np.linalg.norm(g)
    axes = [(np.arange(n) + 0.5) / n * size for n, size in ((160, 2), (80, 1), (80, 1))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) @ turn.T
    volume = 2 * (points @ up < 0.1).mean()
    assert 0.05 < volume < 1.95
    np.testing.assert_allclose(forces(sim).sum(axis=0), -1000 * volume * g, rtol=5e-3, atol=1e-6 * 1e4)


def test_fluid_does_not_reach_a_closed_cavity_but_an_open_one(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    closed, opened = (hollow(tmp_path / name, None, mesh=box(opened=name == "b")) for name in "ab")
    hull = {"level": 2.0, "where": f"not ({TUBE})"}
    lifts = []
    for given, fluid in ((closed, {"level": 2.0}), (opened, {"level": 2.0}), (opened, hull)):
        given["effects"]["buoyancy"] = fluid
        lifts.append(forces(Simulation(scene(given, gravity=G))).sum(axis=0)[1])
    np.testing.assert_allclose(np.array(lifts[:2]) / 9810, [1, 1 - 0.1875], rtol=1e-12)
    assert lifts[2] > lifts[1]


@pytest.mark.parametrize("integrator", [{}, {"scheme": "ros2", "solve": "iterate"}, {"scheme": "central_difference"}])
def test_a_bar_floats_at_the_depth_of_its_weight(integrator):
    """0.6 of its height in a fluid whose level then falls; damped, so that it rests; flat, so that it is stable."""
    solver = {} if integrator.get("scheme") == "central_difference" else {"tolerance": 1e-10}
    sim = floating(
        {"level": 0.4}, integrator, density=600, young=1e7, size=(2, 0.5, 2), damping=(4.0, 0.0), solver=solver
    )
    driver = Driver(sim)
    assert (driver.advance(150)["status"] == 0).all()
    for level in (0.4, 0.2):
        sim.parameters.set({"bar.buoyancy.level": str(level)})
        records = driver.advance(250)
        assert (records["status"] == 0).all()
        bottom = sim.fetch().x[:, 1].min()
        assert level - bottom == pytest.approx(0.3, abs=0.005)
        assert np.abs(sim.world.v).max() < 0.02


def test_what_the_fluid_does_is_work():
    """Undamped: kinetic energy and elastic energy are the work of the fluid and of gravity."""
    sim = floating(
        {"level": 3.0}, {"scheme": "ros2", "solve": "iterate"}, dt=0.005, young=1e6, solver={"tolerance": 1e-10}
    )
    records = Driver(sim).advance(60)
    fallen = -9.81 * sim.world.mass @ (sim.fetch().x[:, 1] - sim.world.rest[:, 1])
    energy = sim.kinetic_energy() + sum(e.energy() for name, e in sim.effects.items() if name != "gravity")
    assert energy == pytest.approx(records["work"][-1] + fallen, rel=0.04) and energy > 1000


def test_depth_squeezes():
    """In a static scene, held at its bottom: p = 3 K e at depth, to the first order of what the ends differ."""
    fixed = [{"where": f"{axis.upper()} < 0.01", "along": axis} for axis in "xyz"]
    given = bar(young=1e8, poisson=0.3, density=1e-9)
    given["effects"] |= {"buoyancy": {"level": 100.0}, "fixed": fixed}
    sim = Simulation(
        scene(given, integrator={"scheme": "quasi_static", "linearizations": 5}, gravity=G, tolerance=1e-10)
    )
    Driver(sim).advance(1)
    strain = -1000 * 9.81 * 99.5 / (3 * 1e8 / 3 / 0.4)
    assert sim.fetch().x[:, 0].max() / 2 - 1 == pytest.approx(strain, rel=0.02)


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="buoyancy needs gravity"):
        floating({"level": 1.0}, gravity=None)
    with pytest.raises(InputError, match="holds all nodes of 0 of"):
        floating({"level": 1.0, "where": "X > 5"})
    for wrong in ({}, {"level": 1.0, "density": -1.0}):
        with pytest.raises(ValidationError):
            floating(wrong)
