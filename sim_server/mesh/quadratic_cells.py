# SPDX-License-Identifier: MIT
"""Strain cells of quadratic tetrahedra: the points of integration of each, which share its mean dilatation.

Four points and one dilatation an element: Hughes, The Finite Element Method, 1987, section 4.5 (selective integration,
mean dilatation). They do not lock as Poisson's ratio nears 0.5.
"""

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.mesh.shape_functions import quadratic_gradients
from sim_server.mesh.strain_cells import StrainCells


def quadratic_cells(rest: Float64, quadratic: Int32) -> StrainCells:
    """Returns the cells of elements (m, 10), 4 m of ten nodes each; a patch is an element. rest: (n, 3) [m]

    Elements are in the order of their first nodes, so that those near in the mesh are near in memory, and so are
    patches. The material constants of a cell are those of the first of the eight tets of its element, which all have
    those at the centroid of the element.
    """
    order = np.argsort(quadratic.min(axis=1), kind="stable").astype(np.int32)
    quadratic = quadratic[order]
    parts, gradients = quadratic_gradients(rest, quadratic)
    owner = np.repeat(np.arange(len(quadratic), dtype=np.int32), 4)
    return StrainCells(
        start=np.arange(0, 10 * len(owner) + 1, 10, dtype=np.int32),
        nodes=np.repeat(quadratic, 4, axis=0).ravel(),
        gradients=gradients.reshape(-1, 3),
        volume=parts.ravel(),
        element=8 * order[owner],
        patch=owner,
    )
