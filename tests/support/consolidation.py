# SPDX-License-Identifier: MIT
"""A column of soil whose fluid leaves through its top, and Terzaghi's series of it."""

from typing import Any

import numpy as np

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

YOUNG, STORAGE, MOBILITY = 1e5, 1e6, 1e-9
LOAD = 10.0
STORED = 1 / STORAGE + 1 / YOUNG  # with a Poisson's ratio of 0


def column(cells: int, steps: int, split: str = "mirrored", **fluid: Any) -> Simulation:
    """A column of 1 m that cannot widen, is drained and loaded at its top, in steps of a part of cv t / H^2 = 1."""
    size = 1 / cells
    top = f"Z > {1 - size / 4}"
    rollers = [{"where": "Z < 1e-6", "along": "z"}, {"where": "true", "along": ["x", "y"]}]
    effects = {
        "corotational": {"young": YOUNG, "poisson": 0}, "fixed": rollers, "traction": {"where": top, "pressure": LOAD},
        "poroelasticity": {"mobility": MOBILITY, "storage": STORAGE, "drained": top} | fluid,
    }  # fmt: skip
    mesh = {"bar": [1, 1, cells], "size": [size, size, 1], "split": split}
    integrator = {"scheme": "quasi_static", "linearizations": 3}
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-10, "max_iterations": 2000}
    table = {"name": "column", "dt": STORED / MOBILITY / steps, "integrator": integrator, "solver": solver}
    return Simulation(Scene.model_validate(table | {"object": [{"name": "column", "mesh": mesh, "effects": effects}]}))


def settlement(sim: Simulation) -> float:
    """Of the top [m]."""
    return float(1 - sim.fetch().x[:, 2].max())


def consolidation(time: float) -> float:
    """Returns Terzaghi's degree of consolidation at cv t / H^2."""
    m = np.pi / 2 * (2 * np.arange(200) + 1)
    return float(1 - np.sum(2 / m**2 * np.exp(-(m**2) * time)))
