# SPDX-License-Identifier: MIT
"""Bodies that touch each other: momentum of two that collide, what each level of a stack carries."""

from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import G, Reals, Row
from tests.bench.contact.ladder import JACOBI, line
from tests.contact.scenes import SIZE, D, block, floor, over

COUNTS = (2, 4, 8)
STEPS = 240  # until a stack is at rest


def collisions() -> list[Row]:
    """Off centre, one turned, without gravity: linear momentum."""
    far, found = floor(pose={"translate": [0, -100, 0]}), []
    contact = {"thickness": D, "tolerance": 1e-6, "passes": 200}
    for friction in (0.0, 0.5):
        for speed in (0.5, 5.0):
            two = [
                block(name="one", friction=friction, at=(0, 0, 0)),
                block(name="other", friction=friction, at=(0.03, 0.1, 0.02), rotate=(10, 30, 5)),
            ]
            sim = over(far, objects=two, gravity=(0, 0, 0), contact=contact,
                       solver=JACOBI | {"tolerance": 1e-12})  # fmt: skip
            one, other = sim.world.bodies
            sim.world.v[one.nodes], sim.world.v[other.nodes] = (0, speed, 0), (0.2 * speed, -speed, 0)
            before = sim.world.mass @ sim.world.v
            records = Driver(sim).advance(int(0.3 / speed / sim.world.dt) + 4)
            size = float(sim.world.mass.sum()) * speed
            apart = float(np.linalg.norm(sim.world.mass @ sim.world.v - before)) / size
            touched = bool(records["contacts"].any())
            name = f"two blocks collide at {speed:g} m/s each, friction {friction:g}: change of momentum over m v"
            found.append(line(name, 0, apart if touched else float("inf"), 1e-9))
    return found


def stack(count: int, **table: Any) -> Simulation:
    """Blocks one over another, each a little aside."""
    blocks = [block(name=f"b{i}", at=(0.003 * (i % 2), D + i * (SIZE[1] + D), 0.002 * (i % 2))) for i in range(count)]
    return over(objects=blocks, **table)


def carried(sim: Simulation, level: int) -> Reals:
    """Force on the bodies from `level` up by those below, (3,) [N]."""
    rows = sim.contact.contact_input()
    used = (rows.obstacle >= 0) & (rows.corner[:, 1] >= 0)
    corner, weight = rows.corner[used], rows.weight[used] * (rows.corner[used] >= 0)
    upper = corner >= sim.world.bodies[level].first
    between = upper.any(axis=1) & ~(upper | (corner < 0)).all(axis=1)
    force = rows.force[used, None] * rows.normal[used] + rows.traction[used]
    share = (weight * upper).sum(axis=1)
    total: Reals = (share[:, None] * force)[between].sum(axis=0)
    return total


def stacks(counts: tuple[int, ...] = COUNTS) -> list[Row]:
    """At rest: the level that is furthest from what lies on it, and the floor."""
    found = []
    for count in counts:
        sim = stack(count)
        driver = Driver(sim)
        driver.advance(STEPS)
        weight = float(sim.world.mass.sum()) * G
        down = -float(driver.reactions[-count:, 0, 1].sum())
        found.append(line(f"stack of {count}: force on the floor [N]", weight, down, 1e-3))
        ratios = [carried(sim, k)[1] / (weight * (count - k) / count) for k in range(1, count)]
        worst = max(ratios, key=lambda r: abs(r - 1))
        name = f"stack of {count}: force between two blocks over the weight above them, worst level"
        found.append(line(name, 1, float(worst), 1e-3))
    return found
