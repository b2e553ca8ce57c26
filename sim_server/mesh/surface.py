# SPDX-License-Identifier: MIT
"""Volumes and the outer surface of a tetrahedral mesh."""

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32

# Faces of a tetrahedron of positive volume, normals outward by the right-hand rule.
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def volumes(rest: Float64, tets: NDArray[np.integer]) -> Float64:
    """Signed volumes [m3], (m,): det(x1 - x0, x2 - x0, x3 - x0) / 6."""
    a, b, c = (rest[tets[:, k]] - rest[tets[:, 0]] for k in (1, 2, 3))
    return np.einsum("ij,ij->i", np.cross(a, b), c) / 6.0


def surface_triangles(tets: NDArray[np.integer]) -> Int32:
    """Returns the faces of one tetrahedron only, (t, 3), outward for positive volumes, in order of the tetrahedra."""
    faces = tets[:, FACES].reshape(-1, 3)
    corners = np.sort(faces, axis=1)
    order = np.lexsort(corners.T)
    differs = np.any(np.diff(corners[order], axis=0) != 0, axis=1)
    starts = np.concatenate([[True], differs])  # where a new face begins in sorted order
    single = starts & np.concatenate([differs, [True]])
    return faces[np.sort(order[single])].astype(np.int32)


def edge_owners(triangles: Int32) -> Int32:
    """Returns which edges each triangle owns, (t,): bit k for the edge from its corner k to the next one.

    Each edge belongs to the first of the triangles that have it.
    """
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    first = np.zeros(len(edges), bool)
    first[np.unique(edges, axis=0, return_index=True)[1]] = True
    return (first.reshape(-1, 3) @ [1, 2, 4]).astype(np.int32)
