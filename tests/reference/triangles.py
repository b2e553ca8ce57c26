# SPDX-License-Identifier: MIT
"""Points and triangles: distances, inside or outside of a closed surface, and when a path comes near.

Arrays of triangles are (n, 3, 3), of points (n, 3).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEVER = 2.0


def distances(p: Array, corners: Array) -> Array:
    """Of points from their triangles: from the plane where the foot is inside, else from the nearest edge."""
    best = np.full(len(p), np.inf)
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        square = np.maximum(((b - a) ** 2).sum(axis=1), 1e-300)
        t = np.clip(((p - a) * (b - a)).sum(axis=1) / square, 0, 1)
        best = np.minimum(best, np.linalg.norm(p - a - t[:, None] * (b - a), axis=1))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    inside = size > 1e-12
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        inside &= (np.cross(b - a, p - a) * normal).sum(axis=1) >= 0
    height = abs(((p - corners[:, 0]) * normal).sum(axis=1)) / np.maximum(size, 1e-300)
    return np.where(inside, height, best)


def normals(corners: Array) -> Array:
    """Unit normals by the right-hand rule."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


def is_inside(p: Array, corners: Array) -> bool:
    """Whether a point (3,) is inside a closed surface, by solid angles (van Oosterom and Strackee, 1983)."""
    a, b, c = (corners[:, k] - p for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    det = np.einsum("ij,ij->i", a, np.cross(b, c))
    bottom = la * lb * lc + (a * b).sum(1) * lc + (a * c).sum(1) * lb + (b * c).sum(1) * la
    return bool(2 * np.arctan2(det, bottom).sum() > 2 * np.pi)


def entries(p: Array, path: Array, corners: Array, thickness: float) -> tuple[Array, Array]:
    """When paths first come nearer to their triangles than the thickness, starting further away; NEVER. And how near
    they come. A distance along a straight path is convex: its least value by thirds, the entry by bisection."""

    def away(t: Array) -> Array:
        return distances(p + t[:, None] * path, corners)

    low, high = np.zeros(len(p)), np.ones(len(p))
    for _ in range(36):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        falls = away(a) > away(b)
        low, high = np.where(falls, a, low), np.where(falls, high, b)
    nearest = np.minimum(away((low + high) / 2), away(np.ones(len(p))))
    low, high = np.zeros(len(p)), np.where(away(np.ones(len(p))) <= nearest, 1.0, (low + high) / 2)
    for _ in range(40):
        middle = (low + high) / 2
        near = away(middle) <= thickness
        low, high = np.where(near, low, middle), np.where(near, middle, high)
    return np.where(nearest <= thickness, high, NEVER), nearest
