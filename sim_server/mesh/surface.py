# SPDX-License-Identifier: MIT
"""Volumes and the outer surface of a tetrahedral mesh."""

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64

# Faces of a tetrahedron of positive volume, normals outward by the right-hand rule.
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])


def volumes(rest: Float64, tets: NDArray[np.integer]) -> Float64:
    """Signed volumes [m3], (m,): det(x1 - x0, x2 - x0, x3 - x0) / 6."""
    a, b, c = (rest[tets[:, k]] - rest[tets[:, 0]] for k in (1, 2, 3))
    return np.einsum("ij,ij->i", np.cross(a, b), c) / 6.0


def surface_triangles(tets: NDArray[np.integer]) -> Int32:
    """Returns the faces of one tetrahedron only, (t, 3), outward for positive volumes, in order of the tetrahedra."""
    return tets[:, FACES].reshape(-1, 3)[surface_faces(tets)].astype(np.int32)


def surface_faces(tets: NDArray[np.integer]) -> Int64:
    """Returns the numbers of the faces of one tetrahedron only, (t,) ascending: 4 times its own + row of FACES."""
    order, starts = grouped_faces(tets)
    single = starts & np.append(starts[1:], True)
    return np.sort(order[single])


def grouped_faces(tets: NDArray[np.integer]) -> tuple[Int64, NDArray[np.bool_]]:
    """Returns the numbers of all faces, those with the same nodes together, and where others begin, (4 m,) each."""
    corners = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(corners.T)
    differs = np.any(np.diff(corners[order], axis=0) != 0, axis=1)
    return order, np.concatenate([[True], differs])


def surface_edges(triangles: Int32) -> tuple[Int32, Int32, Int32]:
    """Returns the edges of a closed surface (e, 2) as their owners have them, the third corners of both triangles of
    each (e, 2), and the edge of each triangle from its corner k to the next one, -1 where it is another's, (t, 3).

    Edges are in the order of their owners. Of an edge with more than two triangles the first two count.
    """
    owned = (edge_owners(triangles)[:, None] >> np.arange(3) & 1).astype(bool)
    number = np.where(owned, np.cumsum(owned).reshape(-1, 3) - 1, -1).astype(np.int32)
    pairs, third = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), np.roll(triangles, -2, axis=1)
    found: dict[tuple[int, int], list[int]] = {}
    for (p, q), r in zip(pairs.reshape(-1, 2).tolist(), third.ravel().tolist(), strict=True):
        found.setdefault((min(p, q), max(p, q)), []).append(r)
    edges = pairs[owned]
    both = [found[min(p, q), max(p, q)] for p, q in edges.tolist()]
    opposite = [(r[0], r[1] if len(r) > 1 else r[0]) for r in both]
    return edges.astype(np.int32), np.array(opposite, np.int32).reshape(-1, 2), number


def edge_owners(triangles: Int32) -> Int32:
    """Returns which edges each triangle owns, (t,): bit k for the edge from its corner k to the next one.

    Each edge belongs to the first of the triangles that have it.
    """
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    first = np.zeros(len(edges), bool)
    first[np.unique(edges, axis=0, return_index=True)[1]] = True
    return (first.reshape(-1, 3) @ [1, 2, 4]).astype(np.int32)
