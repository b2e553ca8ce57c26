# SPDX-License-Identifier: MIT
"""Which points are near each other, and how far points are from triangles."""

from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int64


def within(points: Float64, others: Float64, reach: float | Float64) -> tuple[Int64, Int64]:
    """Returns the pairs of a point and another one that are no farther apart than `reach`, in the order of the points.

    reach: one for all, or of each point [m]
    """
    from scipy.spatial import cKDTree

    found: Any = cKDTree(others).query_ball_point(points, reach)
    count = np.array([len(f) for f in found], np.int64)
    return np.repeat(np.arange(len(points)), count), np.concatenate([*found, []]).astype(np.int64)


def triangle_distances(p: Float64, corners: Float64) -> Float64:
    """Returns the distance of each point (n, 3) from its triangle (n, 3, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    over, from_edges = size > 0, np.full(len(p), np.inf)
    for k in range(3):
        a, along = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        off = p - a
        t = np.einsum("ij,ij->i", off, along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
        nearest = off - np.clip(t, 0, 1)[:, None] * along
        from_edges = np.minimum(from_edges, np.linalg.norm(nearest, axis=1))
        over &= np.einsum("ij,ij->i", np.cross(along, off), normal) >= 0
    height = abs(np.einsum("ij,ij->i", p - corners[:, 0], normal)) / np.maximum(size, 1e-300)
    return np.where(over, height, from_edges)
