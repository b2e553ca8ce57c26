# SPDX-License-Identifier: MIT
"""The bar with a layer of cells a thousandth as thick: flat elements with dihedral angles below 1 degree."""

import itertools
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from sim_server.mesh import bar
from sim_server.simulation import Simulation
from tests.hard_cases.case import BAR

THICKNESS = 1e-3  # of the squeezed layer / cell


def sliver_bar(
    overrides: list[str], folder: Path, file: Path = BAR, cells: tuple[int, int, int] = (3, 3, 12), device: str = "cpu"
) -> Simulation:
    """A scene's bar on that mesh, which goes through a file as a user's would."""
    path = folder / "slivers.vtu"
    mesh = bar(list(cells), [1, 1, 4], "kuhn")
    rest, cell = mesh.rest.copy(), 4 / cells[2]
    above = rest[:, 2] > (cells[2] // 2 + 0.5) * cell
    rest[above, 2] -= (1 - THICKNESS) * cell
    meshio.write(path, meshio.Mesh(rest, [("tetra", mesh.tets)]))
    return Simulation.load(file, [f'object.bar.mesh={{ file = "{path}" }}', *overrides], device)


def smallest_dihedral(rest: NDArray[np.float64], tets: NDArray[np.int32]) -> float:
    """Over all edges of all elements [degrees]."""
    corners, least = rest[tets], np.inf
    for a, b in itertools.combinations(range(4), 2):
        c, d = (k for k in range(4) if k not in (a, b))
        axis = corners[:, b] - corners[:, a]
        sides = [np.cross(axis, corners[:, k] - corners[:, a]) for k in (c, d)]
        cosine = (sides[0] * sides[1]).sum(axis=1) / np.prod([np.linalg.norm(s, axis=1) for s in sides], axis=0)
        least = min(least, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).min()))
    return least
