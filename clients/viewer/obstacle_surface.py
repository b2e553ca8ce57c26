# SPDX-License-Identifier: MIT
"""The surface of an obstacle as triangles, for pictures."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clients.log.obstacles import Obstacle

COLOR = (150, 155, 165, 255)  # RGBA
AROUND = 32  # points on a circle of a sphere or capsule


class ObstacleSurface(NamedTuple):
    """vertices (n, 3) [m] in the obstacle's own frame, triangles (t, 3)."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]


def obstacle_surface(obstacle: Obstacle, low: NDArray, high: NDArray) -> ObstacleSurface:
    """Returns the surface. low, high (3,): of a box around the bodies [m], below which a plane is drawn as a square."""
    if obstacle.shape in ("grid", "holder"):
        return ObstacleSurface(obstacle.vertices, obstacle.triangles)
    if obstacle.shape == "plane":
        return _square(obstacle, low, high)
    if obstacle.shape == "box":
        return _box(np.array(obstacle.size) / 2)
    radius, length = (*obstacle.size, 0.0)[:2]
    return _capsule(radius, length / 2)


def _square(obstacle: Obstacle, low: NDArray, high: NDArray) -> ObstacleSurface:
    """A part of the plane below the middle of the box, twice as wide as the box is long."""
    reach = float(np.linalg.norm(high - low)) or 1.0
    x, _, z = ((low + high) / 2 - obstacle.start.position) @ obstacle.start.matrix()
    corners = [(x + a * reach, 0.0, z + b * reach) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
    return ObstacleSurface(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def _box(half: NDArray) -> ObstacleSurface:
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return ObstacleSurface(corners, np.array(triangles, np.int32))


def _capsule(radius: float, half: float) -> ObstacleSurface:
    """A surface of revolution about y: two half-spheres, at `half` above and below the middle."""
    quarter = np.linspace(0, np.pi / 2, AROUND // 4 + 1)
    latitude = np.concatenate([-quarter[::-1], quarter])
    middle = np.concatenate([np.full(len(quarter), -half), np.full(len(quarter), half)])
    turn = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = radius * np.cos(latitude)[:, None]
    height = np.broadcast_to((middle + radius * np.sin(latitude))[:, None], (len(latitude), AROUND))
    vertices = np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], axis=-1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(len(latitude) - 1), np.arange(AROUND), indexing="ij")
    a, b = row * AROUND + column, row * AROUND + (column + 1) % AROUND
    triangles = np.stack([a, a + AROUND, b, b, a + AROUND, b + AROUND], axis=-1).reshape(-1, 3)
    return ObstacleSurface(vertices, triangles.astype(np.int32))
