# SPDX-License-Identifier: MIT
"""Fills the surface in surface.npz of the current folder with tetrahedra: what fill.py runs in a folder of its own.

fTetWild writes files into the current folder, and an error of its own would end a whole server. Run by its path: it
imports nothing of ours.
"""

import sys
import types
from importlib.util import find_spec

import numpy as np


def pyvista_is_not_needed() -> None:
    """Lets pytetwild 0.4 be imported: it imports pyvista, which it does not require and which filling does not need."""
    if find_spec("pyvista") is None:
        sys.modules["pyvista"] = types.ModuleType("pyvista")


def main() -> None:
    """Writes mesh.npz: rest (n, 3) [m], tets (m, 4)."""
    pyvista_is_not_needed()
    from pytetwild import tetrahedralize

    with np.load("surface.npz", allow_pickle=False) as given:
        rest, tets = tetrahedralize(
            given["points"],
            given["triangles"].astype(np.int32),
            edge_length_abs=float(given["edge"]),
            epsilon=float(given["envelope"]),
        )
    np.savez("mesh.npz", rest=np.asarray(rest, np.float64), tets=tets)


if __name__ == "__main__":
    main()
