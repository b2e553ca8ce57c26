# SPDX-License-Identifier: MIT
"""Linear shape functions of tetrahedra."""

import numpy as np

from sim_server.arrays import Float64, Int32


def shape_gradients(rest: Float64, tets: Int32) -> tuple[Float64, Float64]:
    """Volumes (m,) [m3] and rest gradients of the shape functions of corners 1, 2, 3, (m, 3, 3) [1/m]."""
    edges = rest[tets[:, 1:]] - rest[tets[:, :1]]  # rows are edges: Dm^T
    return np.linalg.det(edges) / 6, np.ascontiguousarray(np.swapaxes(np.linalg.inv(edges), 1, 2))
