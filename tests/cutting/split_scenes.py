# SPDX-License-Identifier: MIT
"""Bars that are split along faces of their elements, on any device."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.mechanics.cut_shapes import border
from sim_server.mechanics.splitting import Split, Splitter, opening
from sim_server.scene.where import mask
from sim_server.simulation import Simulation
from tests.cutting.cut_scenes import LAWS

SPLIT_LAWS = [law for law in LAWS if law != "mass_spring"]
SLIT, HALVES = "X > 1 and Y > 0.25", "X > 1"
SPARE = {"cutting": {"spare": 60}}
FINE = {"bar": [12, 4, 4], "size": [2.0, 0.5, 0.5], "split": "mirrored"}
SCHEMES = ["newmark", "bdf2", "generalized_alpha", "central_difference"]


def splitter_of(sim: Simulation) -> Splitter:
    assert sim.world.splitting is not None
    return sim.world.splitting.splitters[0]


def faces_around(sim: Simulation, where: str) -> NDArray[np.int64]:
    """Faces around the elements of a region."""
    chosen = mask(where, sim.world.bodies[0].centroids)
    return border(chosen, splitter_of(sim).faces.owners)


def split(sim: Simulation, where: str) -> Split:
    """Opens the faces around the elements of a region from the next step on; returns what becomes of the mesh."""
    assert sim.world.splitting is not None
    text = sim.parameters.scene.objects[0].effects["cutting"].opened  # type: ignore[attr-defined]
    sim.parameters.set(opening(splitter_of(sim), text, faces_around(sim, where)))
    return sim.world.splitting.of(sim.parameters.scene, 0)


def of_scheme(scheme: str) -> dict[str, Any]:
    """Keys of a scene, whose scheme is stable at its time step."""
    if scheme != "central_difference":
        return {"integrator": {"scheme": scheme}}
    return {"integrator": {"scheme": scheme}, "solver": {"preconditioner": "none"}, "dt": 0.005}
