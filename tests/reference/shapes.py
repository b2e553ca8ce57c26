# SPDX-License-Identifier: MIT
"""Signed distances of rigid shapes in their own frames, by the nearest of many candidates rather than by case."""

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

Array = NDArray[np.float64]


def plane(points: Array) -> Array:
    """Distance of points (n, 3) from the half-space y < 0."""
    return np.asarray(points[:, 1], float)


def sphere(points: Array, radius: float) -> Array:
    return np.linalg.norm(points, axis=1) - radius


def box(points: Array, half: Array) -> Array:
    """By the nearest point of each of the six faces."""
    away = []
    for axis, side in product(range(3), (-1, 1)):
        nearest = np.clip(points, -half, half)
        nearest[:, axis] = side * half[axis]
        away.append(np.linalg.norm(points - nearest, axis=1))
    inside = (np.abs(points) < half).all(axis=1)
    return np.where(inside, -1, 1) * np.min(away, axis=0)


def capsule(points: Array, radius: float, half: float) -> Array:
    """By the distance from a segment between two end points."""
    a, b = np.array([0, -half, 0]), np.array([0, half, 0])
    part = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-300), 0, 1)
    return np.linalg.norm(points - a - part[:, None] * (b - a), axis=1) - radius


def grid(points: Array, first: Array, spacing: float, values: Array) -> Array:
    """Trilinear; outside, the hypotenuse of the distance from the grid's box and the distance at its nearest point."""
    axes = [first[k] + spacing * np.arange(values.shape[k]) for k in range(3)]
    nearest = np.clip(points, first, [axis[-1] for axis in axes])
    inside = RegularGridInterpolator(axes, values)(nearest)
    out = np.linalg.norm(points - nearest, axis=1)
    return np.where(out > 0, np.hypot(out, np.maximum(inside, 0)), inside)


def rotation(quaternion: Array) -> Array:
    """Matrix (3, 3) of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)
