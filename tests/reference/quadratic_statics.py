# SPDX-License-Identifier: MIT
"""Linear statics with quadratic tetrahedra, in NumPy and SciPy: answers that do not depend on the package's elements.

Ten nodes, straight edges, four quadrature points. With `mean` the change of volume of an element is its mean
(constant pressure in each element, condensed): it does not lock, and is as a rule slightly too soft, where the
displacement form, without it, is too stiff: the answer lies between the two.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

Reals = NDArray[np.float64]
Ints = NDArray[np.integer]
FACES = [((0, 1, 2), (4, 5, 6)), ((0, 1, 3), (4, 8, 7)), ((0, 2, 3), (6, 9, 7)), ((1, 2, 3), (5, 9, 8))]
"""Of an element: corners, and the nodes in the middle of the face's edges."""
PAIRS = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]  # corners of the mid-nodes
A, B = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
POINTS = B + (A - B) * np.eye(4)  # barycentric, of equal weight, exact to second degree
SIZE = (1.0, 1.0, 4.0)  # m, of the cantilever of SAG
SAG = {0.3: 400.8, 0.45: 391.9, 0.49: 388.3, 0.499: 387.4, 0.4999: 387.3}
"""Of its free face, mean over the nodes, over force per volume / Young's modulus, by Poisson's ratio: the middle of
24,000 quadratic tetrahedra in displacement form and with a mean dilatation in each, 0.7 % apart at most
(bar 10 x 10 x 40)."""


@dataclass(frozen=True)
class Mesh10:
    """rest (n, 3) [m]: the corners first; tets (m, 10)."""

    rest: Reals
    tets: Ints


def with_mid_nodes(rest: Reals, tets: Ints) -> Mesh10:
    """Adds the middle of each edge of linear tetrahedra."""
    edges = np.sort(tets[:, PAIRS].reshape(-1, 2), axis=1)
    found, number = np.unique(edges, axis=0, return_inverse=True)
    mid = len(rest) + number.reshape(-1, 6)
    return Mesh10(np.concatenate([rest, rest[found].mean(axis=1)]), np.hstack([tets, mid]))


def gradients(mesh: Mesh10) -> tuple[Reals, Reals]:
    """Of the ten shape functions at the four points (m, 4, 10, 3) [1/m], and volumes (m,) [m3]."""
    corners = mesh.rest[mesh.tets[:, :4]]
    edges = corners[:, 1:] - corners[:, :1]
    inverse = np.swapaxes(np.linalg.inv(edges), 1, 2)
    G = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    own = (4 * POINTS - 1)[None, :, :, None] * G[:, None]
    i, j = np.transpose(PAIRS)
    mid = 4 * (POINTS[None, :, i, None] * G[:, None, j] + POINTS[None, :, j, None] * G[:, None, i])
    return np.concatenate([own, mid], axis=2), np.linalg.det(edges) / 6


def displacements(
    mesh: Mesh10, poisson: float, held: NDArray[np.bool_], force: Reals, mean: bool, young: float = 1.0
) -> Reals:
    """Returns u (n, 3) [m]. held: components that are zero, (n, 3); force (n, 3) [N]; mean: see above."""
    g, volume = gradients(mesh)
    mu, bulk = young / (2 + 2 * poisson), young / (3 - 6 * poisson)
    weight = volume / 4
    K = mu * np.einsum("m,mqak,mqbk->mab", weight, g, g, optimize=True)[:, :, None, :, None] * np.eye(3)[:, None, :]
    K = K + mu * np.einsum("m,mqaj,mqbi->maibj", weight, g, g, optimize=True)
    K -= 2 / 3 * mu * np.einsum("m,mqai,mqbj->maibj", weight, g, g, optimize=True)
    if mean:
        h = g.mean(axis=1)
        K += bulk * np.einsum("m,mai,mbj->maibj", volume, h, h, optimize=True)
    else:
        K += bulk * np.einsum("m,mqai,mqbj->maibj", weight, g, g, optimize=True)
    at = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 30)
    row, column = np.repeat(at, 30, axis=1).ravel(), np.tile(at, (1, 30)).ravel()
    size = 3 * len(mesh.rest)
    free = np.flatnonzero(~held.ravel())
    matrix = coo_array((K.ravel(), (row, column)), shape=(size, size)).tocsc()[free][:, free]
    u = np.zeros(size)
    u[free] = _solved(matrix, force.ravel()[free])
    return u.reshape(-1, 3)


def body_force(mesh: Mesh10, force: Reals) -> Reals:
    """Nodal forces (n, 3) [N] of a constant force per volume (3,) [N/m3]."""
    volume = gradients(mesh)[1]
    share = np.outer(volume, [-0.05] * 4 + [0.2] * 6)
    return np.bincount(mesh.tets.ravel(), share.ravel(), len(mesh.rest))[:, None] * force


def face_shares(rest: Reals, tets: Ints, on: NDArray[np.bool_]) -> Reals:
    """Returns the area (n,) [m2] that each node bears of a plane face under a constant stress.

    tets: (m, 4) or (m, 10), of which mid-nodes alone bear anything; on: nodes of the face (n,)
    """
    share = np.zeros(len(rest))
    for corners, mids in FACES:
        nodes = tets[on[tets[:, corners]].all(axis=1)]
        a, b, c = (rest[nodes[:, k]] for k in corners)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        for k in corners if tets.shape[1] == 4 else mids:
            np.add.at(share, nodes[:, k], area / 3)
    return share


def _solved(matrix: coo_array, b: Reals) -> Reals:
    try:
        from sksparse.cholmod import cholesky
    except ImportError:
        return np.asarray(splu(matrix).solve(b))
    return np.asarray(cholesky(matrix)(b))
