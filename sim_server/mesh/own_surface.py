# SPDX-License-Identifier: MIT
"""A surface and itself: which nodes of it are nearby, and where it passes through itself."""

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mesh.proximity import triangle_distances, within

RINGS = 2  # nodes so many edges of tetrahedra apart are nearby
PART = 1 << 20  # pairs that are looked at together


def nearby_nodes(
    tets: NDArray[np.integer], rest: Float64, triangles: Int32, distance: float
) -> tuple[Int64, Int32]:  # fmt: skip
    """Returns which nodes of a surface are nearby, as `start` (nodes + 1,) and `node`: those of node i, ascending and
    with itself, are node[start[i] : start[i + 1]]; inner nodes have none.

    Nearby are nodes within RINGS edges of tetrahedra, so that the other side of a thin part is, and the corners of
    triangles no farther away at rest than `distance` [m].
    """
    from scipy.sparse import coo_array

    n, size = len(rest), tets.shape[1]
    first, second = np.repeat(tets, size, axis=1).ravel(), np.tile(tets, (1, size)).ravel()
    beside = coo_array((np.ones(len(first), np.int32), (first, second)), shape=(n, n)).tocsr()
    beside.data[:] = 1
    surface = np.unique(triangles)
    rows = beside[surface]
    for _ in range(RINGS - 1):
        rows = rows @ beside
        rows.data[:] = 1
    near = rows[:, surface].tocoo()
    one, other = surface[near.row], surface[near.col]
    point, triangle = _close_pairs(rest, surface, triangles, distance)
    known = set(zip(one.tolist(), other.tolist(), strict=True)) if len(point) else set()
    more = [
        (p, q) for p, corners in zip(point.tolist(), triangles[triangle].tolist(), strict=True)
        if not any((p, q) in known for q in corners) for q in corners
    ]  # fmt: skip
    added = np.array(more, np.int64).reshape(-1, 2)
    pairs = np.concatenate([np.stack([one, other], axis=1), added, added[:, ::-1]]).astype(np.int64)
    code = np.unique(pairs[:, 0] * n + pairs[:, 1])
    start = np.searchsorted(code, np.arange(n + 1, dtype=np.int64) * n)
    return start.astype(np.int64), (code % n).astype(np.int32)


def _close_pairs(x: Float64, nodes: Int32, triangles: Int32, distance: float) -> tuple[Int64, Int64]:
    """Returns the pairs of a node and a triangle without it that are no farther apart than `distance`."""
    corners = x[triangles]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max() + distance
    at, triangle = within(x[nodes], middle, reach)
    point = nodes[at]
    other = (triangles[triangle] != point[:, None]).all(axis=1)
    point, triangle = point[other], triangle[other]
    close = np.concatenate([
        triangle_distances(x[point[k : k + PART]], corners[triangle[k : k + PART]]) <= distance
        for k in range(0, max(len(point), 1), PART)
    ])  # fmt: skip
    return point[close].astype(np.int64), triangle[close]


def edges_through_triangles(x: Float64, edges: Int32, triangles: Int32) -> tuple[Int64, Int64]:
    """Returns which edges (e, 2) go through triangles with which they share no node: edge and triangle of each pair."""
    corners, ends = x[triangles], x[edges]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max()
    reach += 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max()
    edge, triangle = within(ends.mean(axis=1), middle, reach)
    apart = (edges[edge][:, :, None] != triangles[triangle][:, None, :]).all(axis=(1, 2))
    edge, triangle = edge[apart], triangle[apart]
    through = np.zeros(len(edge), bool)
    for k in range(0, len(edge), PART):
        part = slice(k, k + PART)
        through[part] = _goes_through(ends[edge[part]], corners[triangle[part]])
    return edge[through], triangle[through]


def _goes_through(ends: Float64, corners: Float64) -> NDArray[np.bool_]:
    """Returns whether each segment (n, 2, 3) goes through its triangle (n, 3, 3), by the signs of volumes."""

    def volume(a: Float64, b: Float64, c: Float64, d: Float64) -> Float64:
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)

    p, q, (a, b, c) = ends[:, 0], ends[:, 1], np.moveaxis(corners, 1, 0)
    sides = np.stack([volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)])
    within = (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    return within & (volume(a, b, c, p) * volume(a, b, c, q) < 0)
