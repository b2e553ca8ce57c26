# SPDX-License-Identifier: MIT
"""Consolidation of a column of soil, in `bench verification`, beside Terzaghi's series."""

from typing import Any

import numpy as np

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.bench.verification.row import Row, absolute, relative

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


def poroelasticity(quick: bool) -> list[Row]:
    """Settlement at once, and as the fluid leaves."""
    source = "Terzaghi, Theoretical Soil Mechanics, 1943"
    cells, steps = (10, 400) if quick else (40, 8000)
    sim, first, last = column(cells, steps), LOAD / (YOUNG + STORAGE), LOAD / YOUNG
    sim.engine.run(1)
    rows = [relative("poroelasticity: settlement at once", first, settlement(sim), 1e-3, source)]
    done = 1
    for time in (0.1, 0.3, 1.0):
        sim.engine.run(round(time * steps) - done)
        done = round(time * steps)
        degree, exact = (settlement(sim) - first) / (last - first), consolidation(time)
        rows.append(
            absolute(f"poroelasticity: part of it at time {time}", exact, degree, 0.05 if quick else 0.02, source)
        )
    return rows
