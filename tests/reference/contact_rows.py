# SPDX-License-Identifier: MIT
"""Which planes stand for obstacles in a step, node by node, from distances alone: normals by differences, times of
entry by dense samples and bisection."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.reference.shapes import Array, rotation

NEVER = 2.0
SAMPLES = 400
Distance = Callable[[Array], Array]


@dataclass
class Row:
    obstacle: int
    entry: float
    distance: float  # at the start of the step
    normal: Array
    gap: float
    drift: Array


def slope(distance: Distance, p: Array, h: float = 1e-6) -> Array:
    """Unit normal of the surface nearest to p."""
    found = np.array([float(distance((p + h * e)[None])[0] - distance((p - h * e)[None])[0]) for e in np.eye(3)])
    return np.asarray(found / np.linalg.norm(found))


def entry(distance: Distance, start: Array, way: Array, inflate: float) -> float:
    times = np.linspace(0, 1, SAMPLES + 1)
    above = distance(start + times[:, None] * way) - inflate
    if above[0] <= 0:
        return 0.0 if slope(distance, start) @ way < 0 else NEVER
    inside = np.flatnonzero(above <= 0)
    if not inside.size:
        return NEVER
    low, high = times[inside[0] - 1], times[inside[0]]
    for _ in range(50):
        middle = (low + high) / 2
        if distance((start + middle * way)[None])[0] > inflate:
            low = middle
        else:
            high = middle
    return float(high)


def row(number: int, distance: Distance, begin: Array, end: Array, x: Array, s: Array, thickness: float) -> Row | None:
    """The plane of one obstacle, poses (7,), for a node at x that goes by s; None if it stays away."""
    (first, turn), (last, turned) = ((pose[:3], rotation(pose[3:])) for pose in (begin, end))
    start, stop = turn.T @ (x - first), turned.T @ (x + s - last)
    away, t = float(distance(start[None])[0]), entry(distance, start, stop - start, thickness)
    if t > 1 and away >= 2 * thickness:
        return None
    place = start + t * (stop - start) if t <= 1 else start
    local = slope(distance, place)
    touched = place - float(distance(place[None])[0]) * local
    normal, now = turned @ local, last + turned @ touched
    return Row(number, t, away, normal, float(normal @ (x - now)), now - (first + turn @ touched))


def rows(found: list[Row | None]) -> list[Row]:
    """The two that a node gets: by entry, then by distance."""
    return sorted((r for r in found if r is not None), key=lambda r: (r.entry, r.distance))[:2]
