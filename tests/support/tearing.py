# SPDX-License-Identifier: MIT
"""A bar that damage tears: the work that it takes, and that of its crack."""

from dataclasses import dataclass

import numpy as np

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

YOUNG, STRENGTH, ENERGY = 1e5, 1e3, 20.0  # Pa, Pa, J/m2
WEAK, OPENING = 0.8 * STRENGTH, 0.15  # strength of the layer that tears [Pa], by how much the bar is drawn out [m]
AREA, STEPS = 0.25**2, 200


@dataclass(frozen=True)
class Torn:
    """The end of a test. work: of the force [J]; damage (m,), and whether each element is in the weak layer (m,)."""

    work: float
    damage: np.ndarray
    weak: np.ndarray


def torn(cells: int) -> Torn:
    """Draws a bar of 1 x 0.25 x 0.25 m apart by 0.15 m, one layer of whose cells is weaker."""
    width = 1 / cells
    layer = f"abs(X - {0.5 + width / 2}) < {0.49 * width}"
    frames = [{"time": 0.0}, {"time": 1.0, "translate": [OPENING, 0, 0]}]
    grip = {"name": "grip", "object": "bar", "where": "X > 0.99", "keyframes": frames}
    fixed = [{"where": "X < 0.01"}, {"where": "true", "along": ["y", "z"]}]
    strength = [{"where": layer, "strength": WEAK}, {"strength": STRENGTH}]
    damage = {"strength": strength, "fracture_energy": ENERGY, "most": 0.999}
    law = {"young": YOUNG, "poisson": 0.0}
    effects = {"corotational": law, "damage": damage, "fixed": {"tables": fixed}}
    mesh = {"bar": [cells, 2, 2], "size": [1, 0.25, 0.25], "split": "kuhn"}
    sim = Simulation(Scene.model_validate({
        "name": "test", "dt": 1 / STEPS, "object": [{"name": "bar", "mesh": mesh, "effects": effects}],
        "holder": [grip], "integrator": {"scheme": "quasi_static", "linearizations": 400, "tolerance": 1e-5},
        "solver": {"preconditioner": "block_jacobi", "tolerance": 1e-9, "max_iterations": 4000},
    }))  # fmt: skip
    force = [0.0]
    for _ in range(STEPS):
        sim.engine.run(1)
        force.append(-sim.world.reaction[0, 0, 0])
    broken = sim.effects["damage"]
    middle = sim.world.rest[broken.elements].mean(axis=1)[:, 0]
    found: np.ndarray = broken.damage  # type: ignore[attr-defined]
    weak = np.abs(middle - 0.5 - width / 2) < width / 2
    return Torn(float(np.trapezoid(force, dx=OPENING / STEPS)), found, weak)


def expected(cells: int) -> tuple[float, float]:
    """Returns the work [J] in closed form, all strain in the weak layer, and the energy of a crack [J] in it."""
    width = 1 / cells
    size = float(np.cbrt(6 * np.sqrt(2) * width * 0.125**2 / 6))
    first, kf = WEAK / YOUNG, ENERGY / (size * WEAK) - WEAK / YOUNG / 2
    strain = np.linspace(0, OPENING / width, 100001)
    intact = np.maximum(np.minimum(1, first / np.maximum(strain, 1e-9) * np.exp(-(strain - first) / kf)), 1e-3)
    intact = np.where(strain < first, 1, intact)
    return float(width * AREA * np.trapezoid(intact * YOUNG * strain, strain)), ENERGY * AREA * width / size
