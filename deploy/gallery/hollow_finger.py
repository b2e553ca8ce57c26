# SPDX-License-Identifier: MIT
"""Makes the mesh of a finger of deploy/scenes/soft_gripper.toml: python -m deploy.gallery.hollow_finger.

A bar that hangs down from y = 0.102 m, with four chambers one above the other nearer to its outer side, x = 0.016 m:
each 8 x 18 x 10 mm, walls of 4 mm at x, of 5 mm at z, of 6 mm at y and between them.
"""

from pathlib import Path

import meshio
import numpy as np

from deploy.gallery.mesher import Floats, Ints
from sim_server.mesh import bar

FILE = Path(__file__).resolve().parents[1] / "scenes" / "hollow_finger.msh"
CELLS, SIZE = (4, 17, 4), (0.016, 0.102, 0.02)


def mesh() -> tuple[Floats, Ints]:
    """Returns nodes (n, 3) [m] and tetrahedra (m, 4); z = 0 is the middle."""
    found = bar(CELLS, SIZE, "mirrored")
    x, y, z = (found.rest[found.tets].mean(axis=1) / SIZE * CELLS).astype(int).T  # the cell of each tetrahedron
    hollow = (x > 0) & (x < 3) & (z > 0) & (z < 3) & (y % 4 > 0)
    used, tets = np.unique(found.tets[~hollow], return_inverse=True)
    return np.round(found.rest[used] - (0, 0, SIZE[2] / 2), 6), tets.reshape(-1, 4).astype(np.int64)


if __name__ == "__main__":
    nodes, tets = mesh()
    meshio.Mesh(nodes, [("tetra", tets)]).write(FILE, file_format="gmsh22", binary=True)
    print(f"{FILE.name}: {len(nodes)} nodes, {len(tets)} tets, {FILE.stat().st_size / 1e3:.0f} kB")
