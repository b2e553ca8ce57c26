# SPDX-License-Identifier: MIT
"""The block of deploy/scenes/stairs.toml on its way down, for a picture."""

from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from tests.bench.contact.bodies import LOCKSTEP, Row
from tests.bench.contact.cost import begun
from tests.bench.harness.report import ROOT

SCENE = ROOT / "deploy" / "scenes" / "stairs.toml"
SHOWN = (0, 14, 30, 45, 60, 72, 84, 96, 110, 130, 180)  # steps


def loaded() -> Simulation:
    solver = [f"solver.{key}={value}" for key, value in LOCKSTEP.items()]
    return Simulation.load(SCENE, solver)


def rows(steps: int = 180) -> list[Row]:
    """Outlines of the block's front face, and what each step took."""
    sim = loaded()
    mesh = sim.world.bodies[0].mesh.rest
    front = np.flatnonzero(mesh[:, 2] > mesh[:, 2].max() - 1e-9)
    low, high = mesh[front, :2].min(axis=0), mesh[front, :2].max(axis=0)
    edge = front[((mesh[front, :2] < low + 1e-9) | (mesh[front, :2] > high - 1e-9)).any(axis=1)]
    around = mesh[edge, :2] - (low + high) / 2
    edge = edge[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
    driver, shapes, records = begun(sim), [], []
    for step in range(steps + 1):
        if step in SHOWN:
            shapes.append({"time": step * sim.world.dt, "x": sim.world.x[edge, 0].tolist(),
                           "y": sim.world.x[edge, 1].tolist()})  # fmt: skip
        if step < steps:
            records.append(driver.advance(1))
    every = np.concatenate(records)
    course = {name: every[name].tolist() for name in ("time", "iterations", "passes", "contacts")}
    return [{"scene": "stairs", "shapes": shapes, **course}]


def draw(axis: Any, row: Row) -> None:
    """The stairs from the side, and the outlines, lighter the earlier."""
    sim = loaded()
    for o in sim.contact.obstacles:
        if o.shape == "box":
            (x, y, _), (width, height, _) = o.pose.translate, o.size
            axis.add_patch(_rectangle(x - width / 2, y - height / 2, width, height))
    floor = next(o for o in sim.contact.obstacles if o.shape == "plane").pose.translate[1]
    axis.add_patch(_rectangle(-0.5, floor - 0.05, 2, 0.05))
    last = row["shapes"][-1]["time"]
    for shape in row["shapes"]:
        share = 0.2 + 0.6 * shape["time"] / last
        axis.fill(shape["x"], shape["y"], color="C0", alpha=share, lw=0)
        axis.plot([*shape["x"], shape["x"][0]], [*shape["y"], shape["y"][0]], "k", lw=0.5)
    axis.set(aspect="equal", xlim=(-0.3, 1.05), ylim=(floor - 0.05, 0.2), xlabel="x [m]", ylabel="y [m]")


def _rectangle(x: float, y: float, width: float, height: float) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((x, y), width, height, color="0.75", lw=0)
