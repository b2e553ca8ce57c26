# SPDX-License-Identifier: MIT
"""What the bound on the passes of a step does: creep, acceleration beyond the limit of friction, stops, iterations."""

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import DT, LOCKSTEP, SIZE, G, Row
from tests.contact.scenes import floor, over

AT_MOST = (1, 2, 3, 5, 16)
CELLS = (8, 5, 8)


def row(passes: int, seconds: float = 1.0) -> Row:
    """One line of the table."""

    def mean(sim: Simulation) -> np.ndarray:
        found: np.ndarray = sim.world.mass @ sim.world.v / sim.world.mass.sum()
        return found

    def made(friction: float = 0.5, degrees: float | None = None, speed: float = 0.0) -> Simulation:
        angle = 0.0 if degrees is None else np.arctan(friction) + np.radians(degrees)
        return over(
            floor(friction), friction=friction, velocity=(speed, 0, 0), dt=DT, cells=CELLS, size=SIZE,
            gravity=(G * np.sin(angle), -G * np.cos(angle), 0), contact={"passes": passes}, solver=LOCKSTEP,
            at=(0, 0.1 * SIZE[0] / CELLS[0], 0),
        )  # fmt: skip

    steps = round(seconds / DT)
    sim = made(degrees=-0.5)
    driver = Driver(sim)
    driver.advance(90)
    before = sim.world.x.mean(axis=0)
    resting = driver.advance(steps)
    creep = 1e3 * float(np.linalg.norm(sim.world.x.mean(axis=0) - before)) / seconds
    beyond = made(degrees=0.5)
    records = Driver(beyond).advance(steps)
    found: Row = {"passes, at most": passes, "creep mm/s": creep, "v m/s": float(mean(beyond)[0])}
    records = [records]
    for friction in (0.1, 0.5):
        slow = made(friction, speed=1.0)
        start = slow.world.x.mean(axis=0)
        records.append(Driver(slow).advance(round(2 * steps * max(1, 0.15 / friction))))
        found[f"stop m, {friction:g}"] = float((slow.world.x.mean(axis=0) - start)[0])
    sliding = records[1][5:55]
    return found | {
        "iterations, sliding": float(sliding["iterations"].mean()),
        "iterations, resting": float(resting["iterations"].mean()),
        "most passes": int(max(r["passes"].max() for r in records)),
        "steps that say contact": int(sum((r["status"] == 8).sum() for r in records)),
    }


def rigid(seconds: float = 1.0) -> Row:
    """What a rigid block does in steps of backward Euler."""
    angle = np.arctan(0.5) + np.radians(0.5)
    stops = {f"stop m, {mu:g}": 1 / (2 * mu * G) - DT / 2 for mu in (0.1, 0.5)}
    return {"v m/s": float(G * (np.sin(angle) - 0.5 * np.cos(angle)) * seconds), **stops}
