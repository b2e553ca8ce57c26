# SPDX-License-Identifier: MIT
"""How many bodies of deploy/scenes/pile.toml a machine carries in real time."""

import tomllib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import LOCKSTEP, Row, of_times, several, times
from tests.bench.contact.cost import begun
from tests.bench.harness.schemes import SCENES

COUNTS = (6, 12, 18, 25, 50)
FALLING, RESTING = 90, 60  # steps; those at rest begin at REST
REST = 150


def pile(bodies: int, device: str) -> Simulation:
    """The lowest blocks of the scene; the more, the higher."""
    table = tomllib.loads((SCENES / "pile.toml").read_text())
    table |= {"name": "pile", "solver": LOCKSTEP, "object": table["object"][:bodies]}
    return Simulation(Scene.model_validate(table, context={"folder": SCENES}), device)


def row(bodies: int, device: str = "cpu", short: bool = False) -> Row:
    """While they fall on each other, and at rest."""
    sim = pile(bodies, device)
    driver = begun(sim)
    falling = _steps(driver, 5 if short else FALLING, bodies)
    if not short:
        driver.advance(REST - FALLING)
    resting = _steps(driver, 5 if short else RESTING, bodies)
    dt = 1e3 * sim.world.dt
    fall, rest = of_times(times(falling, device)), of_times(times(resting, device))
    late = float((times(falling, device) > dt).mean())
    return {
        "device": device, "bodies": bodies, "contacts": int(resting["contacts"].max()),
        "largest speed at the end m/s": float(np.abs(sim.fetch().v).max()),
        "falling: iterations": float(falling["iterations"].mean()), **{f"falling: {k}": v for k, v in fall.items()},
        "steps that take longer than dt": late,
        "rest: iterations": float(resting["iterations"].mean()), "rest: p50 ms": rest["p50 ms"],
        "rest: p99 ms": rest["p99 ms"], "dt ms": dt,
        "in real time": "yes" if fall["p99 ms"] <= dt else "at rest" if rest["p99 ms"] <= dt else "no",
        "not converged": int((falling["status"] != 0).sum() + (resting["status"] != 0).sum()),
    }  # fmt: skip


def _steps(driver: Driver, steps: int, bodies: int) -> NDArray[Any]:
    return several(driver.advance(steps), bodies)
