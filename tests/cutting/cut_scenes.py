# SPDX-License-Identifier: MIT
"""Bars that may be cut."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.mechanics.numbers import text_of
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

LAWS: dict[str, dict[str, Any]] = {
    "corotational": {"young": 2e5, "poisson": 0.4},
    "mass_spring": {"young": 2e5},
    "st_venant_kirchhoff": {"young": 2e5, "poisson": 0.4},
    "neo_hookean": {"young": 2e5, "poisson": 0.4},
    "stable_neo_hookean": {"young": 2e5, "poisson": 0.4},
    "mooney_rivlin": {"c1": 2e4, "c2": 1e4, "bulk": 2e5},
    "veronda_westmann": {"c1": 2e4, "c2": 1.0, "bulk": 2e5},
    "arruda_boyce": {"shear": 5e4, "segments": 8.0, "bulk": 2e5},
}
BAR = {"bar": [8, 2, 2], "size": [2.0, 0.5, 0.5], "split": "mirrored"}
HALVED = "abs(X - 1) < 0.2"  # two layers of cells
KEY = "object.bar.effects.cutting.removed"


def table(law: str = "corotational", **keys: Any) -> dict[str, Any]:
    """A bar along x that hangs at its left end, or with fixed = False falls."""
    effects: dict[str, Any] = {law: LAWS[law], "rayleigh": {"mass": 0.1}, "cutting": True}
    if keys.pop("fixed", True):
        effects["fixed"] = {"where": "X < 0.01"}
    effects |= keys.pop("own", {})
    bar = {"name": "bar", "mesh": keys.pop("mesh", BAR), "density": 1000.0, "effects": effects} | keys.pop("bar", {})
    given = {"effects": {"gravity": {"g": [0, -9.81, 0]}}, "solver": {"tolerance": 1e-10, "max_iterations": 3000}}
    return {"name": "cut", "dt": 0.02, "object": [bar]} | given | keys


def made(law: str = "corotational", **keys: Any) -> Simulation:
    return Simulation(Scene.model_validate(table(law, **keys), context={"folder": "."}))


def elements(sim: Simulation, where: str) -> NDArray[np.int64]:
    """Numbers of the elements whose centroids are in a region."""
    from sim_server.scene.where import mask

    return np.flatnonzero(mask(where, sim.world.bodies[0].centroids))


def cut(sim: Simulation, where: str) -> NDArray[np.int64]:
    """Removes the elements of a region from the next step on; returns their numbers."""
    found = elements(sim, where)
    sim.parameters.set({KEY: f'"{text_of(found)}"'})
    return found
