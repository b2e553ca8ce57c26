# SPDX-License-Identifier: MIT
"""A cube that falls on a floor while a tool, which clients move, and a paddle on keyframes wait above and beside it."""

from typing import Any

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

DT = 0.01

CUBE: dict[str, Any] = {
    "name": "cube",
    "mesh": {"bar": [3, 3, 3], "size": [0.3, 0.3, 0.3], "split": "kuhn"},
    "elements": "linear",
    "pose": {"translate": [0, 0.02, 0]},
    "effects": {"corotational": {"young": 1e5, "poisson": 0.3}, "touch": True},
}
FLOOR: dict[str, Any] = {"name": "floor", "shape": "plane"}
TOOL: dict[str, Any] = {
    "name": "tool", "shape": "capsule", "radius": 0.05, "length": 0.2, "moved": "client", "max_speed": 0.5,
    "pose": {"translate": [0.15, 0.5, 0.15], "rotate": [0, 0, 90]},
}  # fmt: skip
PADDLE: dict[str, Any] = {
    "name": "paddle", "shape": "box", "size": [0.1, 0.4, 0.4],
    "keyframes": [{"time": 0.1, "translate": [1, 0.2, 0.15]}, {"time": 0.3, "translate": [0.5, 0.2, 0.15]}],
}  # fmt: skip


def table(*obstacles: dict[str, Any], **contact: Any) -> dict[str, Any]:
    """A scene file as a table. obstacles: floor, tool and paddle if left out."""
    return {
        "name": "contact", "dt": DT, "object": [CUBE], "obstacle": list(obstacles or (FLOOR, TOOL, PADDLE)),
        "effects": {"gravity": {"g": [0, -9.81, 0]}, "contact": contact or True},
        "solver": {"preconditioner": "block_jacobi"},
    }  # fmt: skip


def contact_simulation(*obstacles: dict[str, Any], **contact: Any) -> Simulation:
    """Of `table`, on the CPU."""
    return Simulation(Scene.model_validate(table(*obstacles, **contact), context={"folder": "."}))
