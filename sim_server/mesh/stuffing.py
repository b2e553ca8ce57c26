# SPDX-License-Identifier: MIT
"""Tetrahedra in a body that is given by signed distances: isosurface stuffing.

The space is a body-centred cubic lattice of tetrahedra. Where an edge leaves the body its crossing is found; a lattice
point that has one too near moves there; what is left of each tetrahedron inside is one, two or three tetrahedra. Edges
and corners of the body are cut off within an edge of the lattice, and parts thinner than that are lost.

Source: Labelle and Shewchuk, Isosurface Stuffing: Fast Tetrahedral Meshes with Good Dihedral Angles, 2007, with its
parameters for uniform tetrahedra, for which it proves dihedral angles of 10.7 to 164.8 degrees however the surface
runs. Here diagonals are those of an order of the nodes; the angles stay within these bounds in what the tests try.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.errors import InputError
from sim_server.mesh.cells import split
from sim_server.mesh.surface import EDGES, volumes

Distances = Callable[[Float64], Float64]
NEAR_LONG, NEAR_SHORT = 0.24999, 0.41189  # part of an edge within which a crossing draws its end
BISECTIONS = 30
MOST_POINTS = 4_000_000  # of the lattice: what a typing error may ask for


def stuffed(distances: Distances, low: Float64, high: Float64, edge: float) -> tuple[Float64, Int32]:
    """Returns nodes (n, 3) [m] and tetrahedra (m, 4) of positive volume.

    distances: of points (k, 3) from the surface, below 0 inside [m], (k,). low, high: of a box around the body [m].
    edge: of the lattice, the longer one of its two [m]. Raises InputError for too many or no tetrahedra.
    """
    count = np.ceil((high - low) / edge - 1e-9).astype(np.int64) + 2
    if not np.isfinite(count).all() or 2 * math.prod((count + 1).tolist()) > MOST_POINTS:
        raise InputError(f"edge = {edge:g} m: too fine, the body needs more than {MOST_POINTS} points; make it longer")
    points, tets = _lattice(low - edge, count, edge)
    inside = np.sign(-distances(points))
    tets = tets[(inside[tets] > 0).any(axis=1)]
    if not len(tets):
        raise InputError(f"edge = {edge:g} m: too coarse, no point of the lattice is inside the body; make it shorter")
    corners = math.prod((count + 1).tolist())
    ends = _unique_edges(tets, inside)
    crossing, part = _crossings(distances, points[ends[:, 0]], points[ends[:, 1]])
    long = (ends < corners).all(axis=1) | (ends >= corners).all(axis=1)
    moved = _draw(points, inside, ends, crossing, part, np.where(long, NEAR_LONG, NEAR_SHORT))
    left = (inside[ends] != 0).all(axis=1)
    tets = tets[(inside[tets] > 0).any(axis=1)]
    return _cut(moved, inside, tets, ends[left], crossing[left], long[left])


def _lattice(origin: Float64, count: Int64, edge: float) -> tuple[Float64, Int64]:
    """Returns points and tetrahedra of the lattice: corners of nx ny nz cubes, and behind them their centres."""
    nx, ny, nz = count.tolist()
    k, j, i = (axis.ravel() for axis in np.mgrid[: nz + 1, : ny + 1, : nx + 1])
    corners = np.stack([i, j, k], axis=1)
    k, j, i = (axis.ravel() for axis in np.mgrid[:nz, :ny, :nx])
    cubes = np.stack([i, j, k], axis=1)
    points = origin + edge * np.concatenate([corners, cubes + 0.5])
    step = np.array([1, nx + 1, (nx + 1) * (ny + 1)])
    after = np.array([1, nx, nx * ny])
    parts = []
    for axis in range(3):  # four tetrahedra around the line between the centres of two cubes
        b, c = (axis + 1) % 3, (axis + 2) % 3
        first = np.flatnonzero(cubes[:, axis] < count[axis] - 1)
        ring = (cubes[first] @ step + step[axis])[:, None] + np.array([0, step[b], step[b] + step[c], step[c]])
        centre = len(corners) + np.stack([first, first + after[axis]], axis=1)
        for k in range(4):
            parts.append(np.concatenate([centre, ring[:, [k, (k + 1) % 4]]], axis=1))
    return points, np.concatenate(parts)


def _unique_edges(tets: Int64, inside: Float64) -> Int64:
    """Returns the edges that go from inside to outside, (e, 2), smaller number first."""
    ends = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1)
    ends = ends[inside[ends].prod(axis=1) < 0]
    return np.unique(ends, axis=0)


def _crossings(distances: Distances, a: Float64, b: Float64) -> tuple[Float64, Float64]:
    """Returns where lines from a to b (e, 3) cross the surface, and at which part of their lengths, (e,)."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    begins = distances(a) < 0 if len(a) else np.zeros(0, bool)
    for _ in range(BISECTIONS if len(a) else 0):
        middle = (low + high) / 2
        same = (distances(a + middle[:, None] * (b - a)) < 0) == begins
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    part = (low + high) / 2
    return a + part[:, None] * (b - a), part


def _draw(
    points: Float64, inside: Float64, ends: Int64, crossing: Float64, part: Float64, near: Float64
) -> Float64:  # fmt: skip
    """Returns the points, those with a crossing too near moved to the nearest one; their `inside` is 0 from now on."""
    vertex = ends.T.ravel()
    share = np.concatenate([part, 1 - part])
    close = np.flatnonzero(share < np.tile(near, 2))
    apart = np.linalg.norm(np.tile(crossing, (2, 1))[close] - points[vertex[close]], axis=1)
    order = np.lexsort((apart, vertex[close]))
    chosen = close[order][np.unique(vertex[close][order], return_index=True)[1]]
    moved = points.copy()
    moved[vertex[chosen]] = np.tile(crossing, (2, 1))[chosen]
    inside[vertex[chosen]] = 0
    return moved


def _cut(
    points: Float64, inside: Float64, tets: Int64, ends: Int64, crossing: Float64, long: NDArray[np.bool_]
) -> tuple[Float64, Int32]:  # fmt: skip
    """Returns what is inside of each tetrahedron.

    Faces with two crossings are split along the diagonal from their node that comes first: crossings of long edges,
    then points of the lattice, then crossings of short edges.
    """
    total = len(points) + len(ends)
    order = np.concatenate(
        [len(points) + np.flatnonzero(long), np.arange(len(points)), len(points) + np.flatnonzero(~long)]
    )
    rank = np.empty(total, np.int64)
    rank[order] = np.arange(total)
    nodes = np.concatenate([points, crossing])[order]
    code = ends @ np.array([len(points), 1])

    def at(p: Int64, q: Int64) -> Int64:
        """Numbers of the crossings of edges."""
        first, second = np.minimum(p, q), np.maximum(p, q)
        return rank[len(points) + np.searchsorted(code, first * len(points) + second)]

    sign = inside[tets]
    by = np.argsort(-sign, axis=1, kind="stable")  # inside, on the surface, outside
    tets = np.take_along_axis(tets, by, axis=1)
    kinds = {"tetra": [], "wedge": [], "pyramid": []}  # type: dict[str, list[Int64]]
    plus, minus = (sign > 0).sum(axis=1), (sign < 0).sum(axis=1)
    for p in range(1, 5):
        for m in range(5 - p):
            a, b, c, d = tets[(plus == p) & (minus == m)].T
            own = [rank[x] for x in (a, b, c, d)]
            match p, m:
                case _, 0:
                    kind, cells = "tetra", own
                case 1, 1:
                    kind, cells = "tetra", [own[0], own[1], own[2], at(a, d)]
                case 1, 2:
                    kind, cells = "tetra", [own[0], own[1], at(a, c), at(a, d)]
                case 1, 3:
                    kind, cells = "tetra", [own[0], at(a, b), at(a, c), at(a, d)]
                case 2, 1:
                    kind, cells = "pyramid", [own[0], own[1], at(b, d), at(a, d), own[2]]
                case 2, 2:
                    kind, cells = "wedge", [own[0], at(a, c), at(a, d), own[1], at(b, c), at(b, d)]
                case _:
                    kind, cells = "wedge", [own[0], own[1], own[2], at(a, d), at(b, d), at(c, d)]
            kinds[kind].append(np.stack(cells, axis=1))
    found = np.concatenate(kinds["tetra"])
    inverted = volumes(nodes, found) < 0
    found[inverted] = found[inverted][:, [0, 1, 3, 2]]
    several = {kind: np.concatenate(kinds[kind]) for kind in ("wedge", "pyramid")}
    found = np.concatenate([found, *(split(nodes, kind, cells) for kind, cells in several.items() if len(cells))])
    used, numbered = np.unique(found, return_inverse=True)
    return nodes[used], numbered.reshape(-1, 4).astype(np.int32)
