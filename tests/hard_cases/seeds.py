# SPDX-License-Identifier: MIT
"""Bars whose free nodes begin anywhere in their bounding box: of many seeds, how many end how."""

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.models import ELASTIC, MODELS_BAR, Table, toml
from tests.hard_cases.running import determinants
from tests.hard_cases.starts import randomly_placed
from tests.state import put

ENDS = BACK, ELSEWHERE, INVERTED, FLOWN = "back at rest", "elsewhere, J > 0", "J <= 0 somewhere", "flown apart"
SPLITS = ("kuhn", "mirrored")
STABLE = {"stable_neo_hookean": ELASTIC}
SMOOTHED = {
    f"corotational, smoothed, {nu}": ({"corotational": ELASTIC | {"poisson": nu}}, "auto") for nu in (0.45, 0.49)
}
SEEDED: dict[str, tuple[Table, str]] = {  # effects, projection; linear elements, but for those of SMOOTHED
    **{f"corotational, {nu}": ({"corotational": ELASTIC | {"poisson": nu}}, "auto") for nu in (0.3, 0.45, 0.49)},
    "stable_neo_hookean": (STABLE, "auto"),
    "stable_neo_hookean, clamp": (STABLE, "clamp"),
    "stable_neo_hookean, absolute": (STABLE, "absolute"),
    "neo_hookean, regularized": ({"neo_hookean": ELASTIC | {"inversion": "regularize"}}, "auto"),
    **SMOOTHED,
}


def fate(
    name: str, split: str, seed: int, cells: tuple[int, int, int] = (3, 3, 12), steps: int = 700, device: str = "cpu",
    precision: str = "float64",
) -> str:  # fmt: skip
    """How a bar of SEEDED that begins at random ends: one of BACK, ELSEWHERE, INVERTED and FLOWN.

    Back: within a thousandth of its length of rest; elsewhere: without self-contact a body may stay folded through
    itself, at rest; flown: not finite, or ten lengths away.
    """
    effects, projection = SEEDED[name]
    mesh = {"bar": list(cells), "size": [1, 1, 4], "split": split}
    tables = {"effects.rayleigh.mass": 1, "mesh": mesh, "elements": "smoothed" if name in SMOOTHED else "linear"}
    tables |= {f"effects.{k}": table for k, table in effects.items()}
    overrides = [f"object.bar.{key}={toml(value)}" for key, value in tables.items()]
    overrides += [f"solver.projection={projection}", f"solver.precision={precision}"]
    sim = Simulation.load(MODELS_BAR, overrides, device)
    rest, length = sim.world.x.copy(), float(np.ptp(sim.world.x))
    randomly_placed(seed)(sim)
    put(sim, sim.world.x, sim.world.x.copy())
    driver, away = Driver(sim), 0.0
    for _ in range(0, steps, 20):
        driver.advance(20)
        away = float(np.abs(sim.fetch().x - rest).max() / length)
        if not away < 10:
            return FLOWN
    if not (determinants(sim) > 0).all():
        return INVERTED
    return BACK if away < 1e-3 else ELSEWHERE
