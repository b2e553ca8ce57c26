# SPDX-License-Identifier: MIT
"""Makes a segmented organ: `python -m tests.support.organ [FOLDER]` writes organ.msh and organ.stl, in mm.

Two lobes that blend; in the larger one a tumour; a ligament is the part of the surface on top of it.
"""

import sys
from pathlib import Path

import meshio
import numpy as np

from sim_server.mesh import Mesh
from sim_server.mesh.stuffing import stuffed
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.shapes import Shape

LOBES = {
    "union": [
        {"sphere": {"radius": 0.06}},
        {"capsule": {"begin": [0.05, -0.01, 0.0], "end": [0.12, 0.0, 0.02], "radius": 0.03}},
    ],
    "smooth": 0.03,
}
TUMOUR = Shape.model_validate({"sphere": {"radius": 0.025, "center": [-0.01, -0.01, 0.0]}})
EDGE = 0.02  # m
TAGS = {"ligament": (7, 2), "tumour": (1, 3), "parenchyma": (2, 3)}


def organ() -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Returns the mesh [m], which tetrahedra are of the tumour (m,), and the triangles of the ligament (t, 3)."""
    shape = Shape.model_validate(LOBES)
    mesh = Mesh(*stuffed(shape.distances, *shape.bounds(), EDGE))
    triangles = surface_triangles(mesh.tets)
    top = (mesh.rest[triangles][:, :, 1] > 0.04).all(axis=1)
    return mesh, TUMOUR.distances(mesh.centroids) < 0, triangles[top]


def write(folder: Path) -> None:
    """Writes organ.msh and organ.stl into a folder [mm]."""
    mesh, tumour, ligament = organ()
    cells = [("triangle", ligament), ("tetra", mesh.tets[tumour]), ("tetra", mesh.tets[~tumour])]
    tags = [np.full(len(part), tag) for (_, part), (tag, _) in zip(cells, TAGS.values(), strict=True)]
    names = {name: np.array(given) for name, given in TAGS.items()}
    given = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    meshio.Mesh(1000 * mesh.rest, cells, cell_data=given, field_data=names).write(
        folder / "organ.msh", file_format="gmsh22", binary=True
    )
    used, numbers = np.unique(surface_triangles(mesh.tets), return_inverse=True)
    meshio.Mesh(1000 * mesh.rest[used], [("triangle", numbers.reshape(-1, 3))]).write(folder / "organ.stl", binary=True)


if __name__ == "__main__":
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
