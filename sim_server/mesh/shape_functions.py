# SPDX-License-Identifier: MIT
"""Linear and quadratic shape functions of tetrahedra."""

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.mesh.quadratic import EDGES

# Barycentric coordinates of the points of the rule that integrates polynomials of degree 2, each with a quarter of
# the weight: Hammer, Marlowe and Stroud, Numerical Integration over Simplexes and Cones, 1956.
NEAR, FAR = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20
POINTS = np.where(np.eye(4) > 0, NEAR, FAR)
# Of the mass of an element, at corners and at nodes on edges: the diagonal of the consistent mass matrix of a straight
# one, scaled to its sum (Hinton, Rock and Zienkiewicz 1976); sums of the rows would be negative at corners.
MASS_PARTS = np.array([1 / 36] * 4 + [4 / 27] * 6)


def shape_gradients(rest: Float64, tets: Int32) -> tuple[Float64, Float64]:
    """Volumes (m,) [m3] and rest gradients of the shape functions of corners 1, 2, 3, (m, 3, 3) [1/m]."""
    edges = rest[tets[:, 1:]] - rest[tets[:, :1]]  # rows are edges: Dm^T
    return np.linalg.det(edges) / 6, np.ascontiguousarray(np.swapaxes(np.linalg.inv(edges), 1, 2))


def quadratic_shapes(points: Float64) -> tuple[Float64, Float64]:
    """Values (p, 10) of the shape functions of a quadratic tetrahedron at points (p, 4) in barycentric coordinates L,
    and their derivatives (p, 10, 3) by L1, L2, L3, with L0 = 1 - L1 - L2 - L3: L (2 L - 1) of corners, 4 La Lb of
    nodes on edges."""
    a, b = np.array(EDGES).T
    values = np.concatenate([points * (2 * points - 1), 4 * points[:, a] * points[:, b]], axis=1)
    by_all = np.zeros((len(points), 10, 4))
    by_all[:, np.arange(4), np.arange(4)] = 4 * points - 1
    by_all[:, 4 + np.arange(6), a] = 4 * points[:, b]
    by_all[:, 4 + np.arange(6), b] = 4 * points[:, a]
    return values, by_all[..., 1:] - by_all[..., :1]


def quadratic_gradients(rest: Float64, quadratic: NDArray[np.integer]) -> tuple[Float64, Float64]:
    """Returns the parts of the volumes of quadratic tetrahedra (m, 10) at the four points of integration, (m, 4) [m3],
    and the rest gradients of their shape functions there, (m, 4, 10, 3) [1/m].

    The mapping is that of the shape functions, so edges may be curved; where it is turned over, the part is negative.
    """
    derivatives = quadratic_shapes(POINTS)[1]
    jacobian = np.einsum("mai,qaj->mqij", rest[quadratic], derivatives)
    parts = np.linalg.det(jacobian) / 24
    regular = np.where((parts != 0)[..., None, None], jacobian, np.eye(3))
    gradients = np.einsum("qaj,mqji->mqai", derivatives, np.linalg.inv(regular))
    return parts, gradients
