# SPDX-License-Identifier: MIT
"""Bodies with a cavity: a box, a cup and a sphere."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.mesh import bar as bar_mesh
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.scenes import mesh_file, scene

INSIDE = "min(min(X, Y), Z) > 0.24 and max(max(X, Y), Z) < 0.76"  # of the box
TUBE = "min(min(X, Y), Z) > 0.24 and max(Y, Z) < 0.76"  # of the cup
VOLUMES = {INSIDE: 0.125, TUBE: 0.1875}  # m3


def box(cells: int = 4, hole: int = 2, opened: bool = False) -> tuple[NDArray, NDArray]:
    """Nodes and elements of a cube of 1 m with a cube of hole cells cut out; opened: through to X = 1."""
    mesh = bar_mesh((cells,) * 3, (1, 1, 1), "kuhn")
    centroids, low = mesh.rest[mesh.tets].mean(axis=1), (cells - hole) / 2 / cells
    inside = (centroids > low) & (centroids < 1 - low)
    inside[:, 0] |= opened & (centroids[:, 0] > low)
    used, tets = np.unique(mesh.tets[~inside.all(axis=1)], return_inverse=True)
    return mesh.rest[used], tets.reshape(-1, 4)


def sphere(cells: int, inner: float, outer: float) -> tuple[NDArray, NDArray]:
    """Nodes and elements of a spherical shell about 0: the box, cubes of which become spheres."""
    rest, tets = box(cells, cells // 2)
    p = 2 * rest - 1
    size = np.abs(p).max(axis=1, keepdims=True)  # from 1/2 to 1
    radius = inner + (outer - inner) * (2 * size - 1)
    return radius * p / np.linalg.norm(p, axis=1, keepdims=True), tets


def hollow(folder: Path, cavity: Any, mesh: tuple[NDArray, NDArray] | None = None, **effects: Any) -> dict[str, Any]:
    """An [[object]] with the effect cavity, unless it is None, and others."""
    law = {"corotational": {"young": 1e5, "poisson": 0.3}}
    table = {"name": "box", "elements": "linear", "density": 1000, "mesh": mesh_file(folder, *(mesh or box()))}
    return table | {"effects": law | ({"cavity": cavity} if cavity is not None else {}) | effects}


def loaded(given: dict[str, Any], integrator: dict | None = None, dt: float = 0.02, **table: Any) -> Simulation:
    """The scene of one such object."""
    made: Scene = scene(given, integrator=integrator, dt=dt, **table)
    return Simulation(made)
