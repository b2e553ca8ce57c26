# SPDX-License-Identifier: MIT
"""Scenes of contact made in a test: a block over obstacles."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sim_server.mesh import bar as bar_mesh
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.reference.corotational import Solid
from tests.scenes import bar, mesh_file
from tests.state import put

CELLS, SIZE = (4, 3, 4), (0.1, 0.06, 0.1)  # of the block [m]
YOUNG = 3e5  # Pa
D = 0.002  # thickness, a tenth of the shortest edge of the surface [m]
LOCKSTEP: dict[str, Any] = {"preconditioner": "cholesky", "update": "lockstep-3"}


def floor(friction: float = 0.5, **table: Any) -> dict:
    """An [[obstacle]]: the half-space y < 0."""
    return {"name": "floor", "shape": "plane", "friction": friction, **table}


def ram() -> dict:
    """An [[obstacle]]: a plate that comes from below at 10 m/s, stops 0.12 m above the floor, and turns there."""
    keys = [(0, -0.3, 0), (0.04, 0.1, 0), (1, 0.1, 20)]
    frames = [{"time": t, "translate": [0, y, 0], "rotate": [0, 0, degrees]} for t, y, degrees in keys]
    return {"name": "ram", "shape": "box", "size": [0.3, 0.02, 0.3], "friction": 0.5, "keyframes": frames}


def thrust() -> dict:
    """An [[obstacle]]: a ball that goes down through a block and the floor at 20 m/s, in two steps of 10 ms."""
    frames = [{"time": 0, "translate": [0.05, 0.3, 0.05]}, {"time": 0.03, "translate": [0.05, -0.3, 0.05]}]
    return {"name": "ball", "shape": "sphere", "radius": 0.05, "friction": 0.5, "keyframes": frames}


def edge() -> list[dict]:
    """[[obstacle]] tables: a plate under two thirds of a block, and a floor 50 micrometres lower under the rest."""
    low = floor(pose={"translate": (0, -5e-5, 0)})
    return [low, {"name": "plate", "shape": "box", "size": (0.13, 0.02, 0.3), "pose": {"translate": (0.015, -0.01, 0)}}]


def fork(folder: Path, cells: tuple[int, int, int] = (8, 5, 2), edge: float = 0.01) -> dict[str, str]:
    """The mesh of two arms along x, two cells thick, that a back at x = 0 joins."""
    mesh = bar_mesh(cells, [edge * c for c in cells], "kuhn")
    middle = mesh.rest[mesh.tets].mean(axis=1) / edge
    kept = mesh.tets[~((middle[:, 0] > 2) & (abs(middle[:, 1] - cells[1] / 2) < cells[1] / 2 - 2))]
    used, tets = np.unique(kept, return_inverse=True)
    return mesh_file(folder, mesh.rest[used], tets.reshape(-1, 4), f"fork {cells}")


def contact_forces(sim: Simulation) -> np.ndarray:
    """Forces of bodies on each other, or on themselves, at their nodes (n, 3) [N]."""
    rows, force = sim.contact.contact_input(), np.zeros_like(sim.world.x)
    for r in np.flatnonzero((rows.obstacle >= 0) & (rows.corner[:, 1] >= 0) & (rows.force > 0)):
        f = rows.force[r] * rows.normal[r] + rows.traction[r]
        np.add.at(force, rows.corner[r], rows.weight[r][:, None] * f)
    return force


def elastic_forces(sim: Simulation, young: float, poisson: float) -> np.ndarray:
    """Those of the reference at the nodes (n, 3) [N], of a scene of one body."""
    w, tets = sim.world, sim.world.bodies[0].mesh.tets
    each = np.ones(len(tets))
    return Solid(w.rest, tets, young * each, poisson * each, w.mass, w.free, w.x, w.v, w.dt).forces()


def block(friction: float = 0.5, cells: Sequence[int] = CELLS, size: Sequence[float] = SIZE, **table: Any) -> dict:
    """An [[object]] with its lowest corner at `at`."""
    pose = {"translate": list(table.pop("at", (0, D, 0))), "rotate": list(table.pop("rotate", (0, 0, 0)))}
    return bar(tuple(cells), tuple(size), young=table.pop("young", YOUNG), friction=friction, pose=pose, **table)


def over(
    *obstacles: dict, objects: Sequence[dict] = (), velocity: ArrayLike = (0, 0, 0), dt: float = 1 / 60,
    gravity: Sequence[float] = (0, -9.81, 0), contact: Any = True, solver: dict | None = None, device: str = "cpu",
    integrator: dict | None = None, holders: Sequence[dict] = (), **table: Any,
) -> Simulation:  # fmt: skip
    """A block, or other objects, over obstacles. velocity: at the start [m/s]; other arguments are the block's.

    contact: parameters, True: of a thickness D, None: without the effect, and without obstacles
    """
    effects: dict[str, Any] = {"gravity": {"g": list(gravity)}}
    if contact is not None:
        effects["contact"] = {"thickness": D} if contact is True else contact
    scene = {
        "name": "test", "dt": dt, "effects": effects, "solver": LOCKSTEP if solver is None else solver,
        "object": list(objects) or [block(**table)], "integrator": integrator or {},
    }  # fmt: skip
    if holders:
        scene["holder"] = list(holders)
    if contact is not None:
        scene["obstacle"] = list(obstacles) or [floor()]
    sim = Simulation(Scene.model_validate(scene, context={"folder": "."}), device)
    put(sim, sim.world.v, velocity)
    return sim
