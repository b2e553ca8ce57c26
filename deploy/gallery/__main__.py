# SPDX-License-Identifier: MIT
"""Makes the meshes of the gallery: python -m deploy.gallery [NAME...] writes sim_server/gallery/NAME.msh and .obj."""

import sys
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from deploy.gallery import shapes
from deploy.gallery.mesher import Floats, Ints, Shape, dihedral_angles, mesh, skin, volumes

FOLDER = Path(__file__).resolve().parents[2] / "sim_server" / "gallery"


@dataclass(frozen=True)
class Made:
    """How a mesh is made: the shape, corners of a box around it, edges of the lattices' cubes of mesh and skin [m]."""

    shape: Shape
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    cell: float
    skin_cell: float


MESHES = {
    "creature": Made(shapes.creature(), (-0.3, -0.02, -0.3), (0.3, 0.5, 0.2), 0.0265, 0.0142),
    "jelly": Made(shapes.jelly(), (-0.08, -0.02, -0.08), (0.08, 0.1, 0.08), 0.019, 0.0075),
    "liver": Made(shapes.liver(), (-0.18, -0.1, -0.1), (0.18, 0.12, 0.1), 0.0168, 0.0082),
    "tentacle": Made(shapes.tentacle(), (-0.1, -0.05, -0.1), (0.4, 0.4, 0.1), 0.025, 0.0125),
}


def write_obj(path: Path, x: Floats, triangles: Ints) -> None:
    """Writes a surface to a tenth of a millimetre."""
    lines = ["v " + " ".join(f"{c:.4f}" for c in row) for row in x]
    lines += ["f " + " ".join(str(k) for k in row) for row in (triangles + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def main(names: list[str]) -> None:
    """Makes the meshes of these names, or all."""
    for name in names or list(MESHES):
        made = MESHES[name]
        low, high = np.array(made.low), np.array(made.high)
        x, tets = mesh(made.shape, low, high, made.cell)
        x = np.round(x, 6)
        meshio.Mesh(x, [("tetra", tets)]).write(FOLDER / f"{name}.msh", file_format="gmsh22", binary=True)
        vertices, triangles = skin(made.shape, low, high, made.skin_cell)
        write_obj(FOLDER / f"{name}.obj", vertices, triangles)
        angle = dihedral_angles(x, tets)
        print(
            f"{name}: {len(x)} nodes, {len(tets)} tets, {1e3 * volumes(x, tets).sum():.3f} l, dihedral angles "
            f"{np.nanmin(angle):.1f} to {np.nanmax(angle):.1f} degrees; skin: {len(vertices)} vertices, "
            f"{len(triangles)} triangles",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
