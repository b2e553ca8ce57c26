# SPDX-License-Identifier: MIT
"""`bench verification`: loads and actuation, each against a closed form."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.effects.cavity import Cavities
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.verification.row import Row, relative
from tests.effects.hollow import INSIDE, hollow, sphere
from tests.scenes import bar, scene

STATIC = {"scheme": "quasi_static", "linearizations": 20, "tolerance": 1e-10}
PLANES = [{"where": f"{axis.upper()} < 0.001", "along": axis} for axis in "xyz"]
YOUNG, G = 1e5, 9.81


def made(table: Mapping[str, Any], integrator: Any = None, dt: float = 0.02, **more: Any) -> Simulation:
    """The scene of one object."""
    return Simulation(scene(dict(table), integrator=integrator, dt=dt, tolerance=1e-11, **more))


def bar_with(effects: Mapping[str, Any], poisson: float = 0.0, **table: Any) -> dict[str, Any]:
    """A bar of 2 x 1 x 1 m."""
    given = bar(density=1000, poisson=poisson, **table)
    return given | {"effects": given["effects"] | effects}


def gripped(given: dict[str, Any]) -> float:
    """The force along x that a holder at x = 2 m exerts on what pulls at it [N]."""
    table = {"name": "held", "dt": 0.02, "object": [given], "integrator": {"scheme": "quasi_static"},
             "holder": [{"name": "grip", "object": "bar", "where": "X > 1.99"}]}  # fmt: skip
    sim = Simulation(Scene.model_validate(table, context={"folder": "."}))
    sim.engine.run(3)
    return -float(sim.engine.records_and_reactions()[1][-1, 0, 0])


def muscles(quick: bool) -> list[Row]:
    """A bar that is held, and one that is free."""
    muscle = {"muscle": {"stress": 2e4, "direction": [1, 0, 0]}}
    sim = made(bar_with(muscle | {"fixed": PLANES}), STATIC)
    Driver(sim).advance(1)
    held = gripped(bar_with(muscle | {"fixed": {"where": "X < 0.01"}}))
    return [
        relative("muscle, held: force [N]", 2e4, held, 1e-5, "stress times area"),
        relative("muscle, free: length [m]", 1.6, sim.fetch().x[:, 0].max(), 1e-6, "2 m (1 - stress / E)"),
    ]


def cavities(quick: bool) -> list[Row]:
    """A thick sphere under pressure inside, and a gas that a pressure outside squeezes."""
    inner, outer, poisson, cells = 0.6, 1.0, 0.3, 8 if quick else 16
    planes = [{"where": f"abs({axis}) < 1e-6", "along": axis.lower()} for axis in "XYZ"]
    with tempfile.TemporaryDirectory() as folder:
        cavity = {"where": "X**2 + Y**2 + Z**2 < 0.37", "pressure": 100.0}
        shell = hollow(Path(folder), cavity, sphere(cells, inner, outer), fixed=planes) | {"elements": "smoothed"}
        sim = made(shell, STATIC)
        squeeze = {"traction": {"where": "max(max(X, Y), Z) > 0.99", "pressure": 300.0}, "fixed": PLANES}
        gas = made(
            hollow(Path(folder), {"where": INSIDE, "amount": 1.0, "exponent": 1.4, "ambient": 1e4}, **squeeze), STATIC
        )
    Driver(sim).advance(1)
    Driver(gas).advance(1)
    rest, u = sim.world.rest, sim.fetch().x - sim.world.rest
    r = np.linalg.norm(rest, axis=1)
    on = np.abs(r - inner) < 1e-6
    widened = ((u * rest).sum(axis=1) / r)[on].mean()
    lame = 100 / YOUNG * inner / (outer**3 - inner**3) * ((1 - 2 * poisson) * inner**3 + (1 + poisson) * outer**3 / 2)
    gas.engine.assemble()
    effect = gas.effects["cavity"]
    assert isinstance(effect, Cavities)
    found = effect.readings()[0]
    return [
        relative("thick sphere: displacement inside [m]", lame, widened, 0.1 if quick else 0.03, "Lamé"),
        relative("sealed gas: (p + p0) V^1.4", 1e4 * 0.125**1.4, (found.pressure + 1e4) * found.volume**1.4, 1e-9,
                 "adiabatic law"),
    ]  # fmt: skip


def cables(quick: bool) -> list[Row]:
    """A finger that a tendon bends."""
    cells = (10, 2, 4) if quick else (40, 2, 8)
    path = [[k / 20, 0.05, 0.1] for k in range(0, 21, 2 if quick else 1)]
    given = bar(cells=cells, size=(1.0, 0.1, 0.1), poisson=0.0, tangent="exact", fixed="X < 0.001", elements="smoothed")
    given["effects"]["cable"] = {"path": path, "tension": 4.0}
    sim = made(given, STATIC | {"linearizations": 40}, 1.0, preconditioner="cholesky", update="every-1")
    Driver(sim).advance(2)
    rest, x = sim.world.rest, sim.fetch().x
    low, high = (x[(rest[:, 0] > 0.999) & (abs(rest[:, 2] - z) < 1e-6)].mean(axis=0) for z in (0, 0.1))
    turn = np.arctan2(-(high - low)[0], (high - low)[2])
    return [
        relative("tendon: turn of a finger [rad]", 4 * 0.05 / (YOUNG * 1e-4 / 12), turn, 0.15 if quick else 0.05,
                 "T d L / (E I), Euler and Bernoulli")
    ]  # fmt: skip


def growing(quick: bool) -> list[Row]:
    """A bar that is free, and one that is clamped."""
    growth = {"growth": {"expansion": 1e-4, "amount": 100.0}}
    sim = made(bar_with(growth | {"fixed": PLANES}, poisson=0.3), STATIC)
    Driver(sim).advance(1)
    along = {"growth": {"expansion": [1e-4, 0, 0], "amount": 100.0}, "fixed": {"where": "X < 0.01"}}
    return [
        relative("thermal expansion, free: length [m]", 2.02, sim.fetch().x[:, 0].max(), 1e-7, "2 m (1 + alpha dT)"),
        relative("thermal expansion, clamped: force [N]", YOUNG * (1 - 1 / 1.01), -gripped(bar_with(along)), 1e-4,
                 "E alpha dT / (1 + alpha dT)"),
    ]  # fmt: skip


def fluids(quick: bool) -> list[Row]:
    """A block that falls through a fluid, and one that floats."""
    falling = bar_with({"wind": {"density": 1000.0, "drag": 1.5}}) | {"density": 50}
    sim = made(falling, gravity=(0, -G, 0))
    Driver(sim).advance(60)
    speed = -(sim.world.mass @ sim.fetch().v / sim.world.mass.sum())[1]
    floating = bar_with({"buoyancy": {"level": 0.4}}, damping=(4.0, 0.0), size=(2, 0.5, 2), young=1e7) | {
        "density": 600
    }
    boat = made(floating, gravity=(0, -G, 0))
    Driver(boat).advance(300)
    return [
        relative("drag: terminal velocity [m/s]", np.sqrt(2 * 100 * G / (1000 * 1.5 * 2)), speed, 1e-3,
                 "m g = rho c A v^2 / 2"),
        relative("buoyancy: draft of a block [m]", 0.3, 0.4 - boat.fetch().x[:, 1].min(), 5e-3, "Archimedes"),
    ]  # fmt: skip


CASES = [muscles, cavities, cables, growing, fluids]
