# SPDX-License-Identifier: MIT
"""A coarser surface whose vertices are vertices of the finer one, so that it moves as that does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROUNDS = 24  # halvings of the interval of cell sizes, at most


def decimated(points: NDArray, triangles: NDArray, most: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Returns the kept vertices (k,), numbers of `points`, and triangles (t, 3) that count in them.

    Vertex clustering (Rossignac and Borrel 1993): of the vertices in a cell of a grid, the one nearest to their mean
    stays; triangles within a cell vanish. Vertices whose normals point to different sides are never joined, so that a
    thin sheet keeps both. points: (n, 3) [m]; most: vertices that may stay.
    """
    if len(points) <= most:
        return np.arange(len(points)), triangles.astype(np.int32)
    side = _side(points, triangles)
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max()) or 1.0
    fine, coarse = 0.0, extent
    kept = _clusters(points, side, low, coarse)
    for _ in range(ROUNDS):
        size = (fine + coarse) / 2
        found = _clusters(points, side, low, size)
        if found.max() + 1 > most:
            fine = size
        else:
            coarse, kept = size, found
            if found.max() + 1 > 0.9 * most:
                break
    return _joined(points, triangles, kept)


def _side(points: NDArray, triangles: NDArray) -> NDArray[np.int64]:
    """Returns which of the six directions of the axes the normal of each vertex is nearest to (n,)."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    total = np.zeros_like(points, dtype=np.float64)
    for k in range(3):
        np.add.at(total, triangles[:, k], faces)
    axis = np.abs(total).argmax(axis=1)
    return 2 * axis + (total[np.arange(len(points)), axis] < 0)


def _clusters(points: NDArray, side: NDArray, low: NDArray, size: float) -> NDArray[np.int64]:
    """Returns the number of each vertex's cluster (n,)."""
    cells = np.floor((points - low) / size).astype(np.int64)
    return np.unique(np.column_stack([cells, side]), axis=0, return_inverse=True)[1].ravel()


def _joined(points: NDArray, triangles: NDArray, cluster: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    count = np.bincount(cluster)
    mean = np.stack([np.bincount(cluster, points[:, k]) for k in range(3)], axis=1) / count[:, None]
    distance = np.linalg.norm(points - mean[cluster], axis=1)
    order = np.lexsort((distance, cluster))
    kept = order[np.searchsorted(cluster[order], np.arange(len(count)))]
    corners = cluster[triangles]
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    corners = corners[whole]
    first = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)[1]
    return kept, corners[np.sort(first)].astype(np.int32)
