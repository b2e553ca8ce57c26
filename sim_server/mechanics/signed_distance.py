# SPDX-License-Identifier: MIT
"""Signed distances from a closed surface, at the nodes of a regular grid.

Distances are exact (signed_distance.cpp). The sign is that of the angle-weighted normal where the nearest point is, on
a face, an edge or a corner (Bærentzen and Aanæs 2005).
"""

import ctypes as c
import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.backends.compiler import native
from sim_server.errors import InputError
from sim_server.mesh.surface_file import read_surface

log = logging.getLogger(__name__)

MOST_NODES = 4_000_000  # of a grid
SAME = 1e-9  # of the size of the surface: nodes nearer than that are one


@dataclass(frozen=True)
class Grid:
    """values (nx, ny, nz): distances [m], negative inside, at first + spacing (i, j, k).

    center, radius: sphere around the surface [m]
    """

    first: Float64
    spacing: float
    values: Float64
    center: Float64
    radius: float


@dataclass(frozen=True)
class Surface:
    """Closed surface: corners (t, 3, 3) of its triangles [m], outward by the right-hand rule, and pseudo-normals.

    normals (t, 7, 3): of each triangle's corners a, b, c, its edges bc, ca, ab, and its face
    """

    corners: Float64
    normals: Float64


def signed_distance_grid(path: str | Path, scale: float, spacing: float, margin: float) -> Grid:
    """Returns the grid of distances from the surface in a file that meshio reads, or of the cells in it.

    scale: of the coordinates in the file; spacing: of the grid; margin: around the surface, beside two cells [m].
    Raises InputError for a surface that is not closed, and for too many nodes.
    """
    points, triangles = read_surface(path)
    try:
        return grid_around(closed_surface(points * scale, triangles), spacing, margin)
    except InputError as error:
        raise InputError(f"surface {path}: {error}") from None


def closed_surface(points: Float64, triangles: Int64) -> Surface:
    """Merges coincident points, turns the surface outward and makes its normals.

    Raises InputError unless it is closed.
    """
    size = float(np.linalg.norm(np.ptp(points[triangles.ravel()], axis=0)))
    if not size > 0:
        raise InputError("all points are one")
    number = _merged(points, SAME * size)
    triangles = number[triangles]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    triangles = triangles[whole]
    corners = points[np.unique(number, return_index=True)[1]][triangles]
    double_area = np.linalg.norm(_cross(corners), axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    if (flat := np.flatnonzero(~(double_area > 1e-12 * longest**2))).size:
        raise InputError(f"triangle {int(np.flatnonzero(whole)[flat[0]])} is flat ({flat.size} such triangles)")
    _check_edges(triangles, points, number, np.flatnonzero(whole))
    if np.einsum("ij,ij->", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) < 0:
        log.warning("surface: it is wound inwards; turned over")
        triangles, corners = triangles[:, ::-1], corners[:, ::-1]
    return Surface(np.ascontiguousarray(corners), _pseudo_normals(triangles, corners))


def _merged(points: Float64, near: float) -> Int64:
    """Numbers the points, those within `near` of each other alike, (n,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(near, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _check_edges(triangles: Int64, points: Float64, number: Int64, original: Int64) -> None:
    """Raises InputError unless each edge has one triangle on either side, wound alike."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    key = edges.min(axis=1) * (number.max() + 1) + edges.max(axis=1)
    forward = edges[:, 0] < edges[:, 1]
    _, back, count = np.unique(key, return_inverse=True, return_counts=True)
    ahead = np.bincount(back, weights=forward)
    for bad, reason in (
        (count == 1, "open: an edge belongs to one triangle only"),
        (count > 2, "not a manifold: an edge belongs to more than two triangles"),
        (ahead != 1, "wound both ways: the triangles at an edge go along it in the same direction"),
    ):
        if (found := np.flatnonzero(bad)).size:
            edge = int(np.flatnonzero(back == found[0])[0])
            ends = [points[int(np.flatnonzero(number == n)[0])] for n in edges[edge]]
            places = " to ".join("(" + ", ".join(f"{c:.4g}" for c in x) + ")" for x in ends)
            raise InputError(
                f"the surface is {reason}, as that from {places} m of triangle {original[edge % len(triangles)]} "
                f"({found.size} such edges); needed: a closed surface"
            )


def _cross(corners: Float64) -> Float64:
    """Returns the normals of triangles (t, 3, 3), of length 2 times the area."""
    crossed: Float64 = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return crossed


def _pseudo_normals(triangles: Int64, corners: Float64) -> Float64:
    """Returns Surface.normals, not of unit length."""
    face = _cross(corners)
    face /= np.linalg.norm(face, axis=1)[:, None]
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(ahead, axis=2) * np.linalg.norm(behind, axis=2)
    angle = np.arccos(np.clip(np.einsum("tij,tij->ti", ahead, behind) / lengths, -1, 1))
    nodes = triangles.max() + 1
    at_node = np.zeros((nodes, 3))
    np.add.at(at_node, triangles, angle[:, :, None] * face[:, None])
    normals = np.zeros((len(triangles), 7, 3))
    normals[:, :3], normals[:, 6] = at_node[triangles], face
    sides = np.stack([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]], axis=1)
    key = sides.min(axis=2) * nodes + sides.max(axis=2)
    _, edge = np.unique(key, return_inverse=True)
    edge = edge.reshape(key.shape)
    at_edge = np.zeros((edge.max() + 1, 3))
    np.add.at(at_edge, edge, np.repeat(face[:, None], 3, axis=1))
    normals[:, 3:6] = at_edge[edge]
    return normals


def grid_around(surface: Surface, spacing: float, margin: float) -> Grid:
    """Returns distances at the nodes of a grid around the surface. Raises InputError for too many nodes."""
    low, high = surface.corners.min(axis=(0, 1)), surface.corners.max(axis=(0, 1))
    grow = margin + 2 * spacing
    cells = np.ceil((high - low + 2 * grow) / spacing)
    if not (cells + 1).prod() <= MOST_NODES:
        least = float(np.cbrt((high - low + 2 * margin).prod() / MOST_NODES))
        raise InputError(
            f"spacing = {spacing:g} m gives a grid of {(cells + 1).prod():.3g} nodes: at most {MOST_NODES}, "
            f"a spacing above {1.1 * least:.3g} m or so"
        )
    shape = cells.astype(int) + 1
    first = (low + high) / 2 - spacing * cells / 2
    nodes = np.stack(
        np.meshgrid(*(f + spacing * np.arange(n) for f, n in zip(first, shape, strict=True)), indexing="ij")
    )
    values = signed_distances(surface, nodes.reshape(3, -1).T).reshape(shape)
    return Grid(first, spacing, values, (low + high) / 2, float(np.linalg.norm(high - low)) / 2)


def signed_distances(surface: Surface, points: Float64) -> Float64:
    """Returns the distances of points (n, 3) from a surface [m], negative inside."""
    corners, normals = (np.ascontiguousarray(a, dtype=np.float64) for a in (surface.corners, surface.normals))
    points, out = np.ascontiguousarray(points, dtype=np.float64), np.zeros(len(points))
    given = [a.ctypes.data for a in (corners, normals, points, out)]
    _library().wf_signed_distances(len(corners), *given[:2], len(points), *given[2:])
    return out


@cache
def _library() -> c.CDLL:
    arguments = [c.c_int, c.c_void_p, c.c_void_p, c.c_int, c.c_void_p, c.c_void_p]
    return native("mechanics/signed_distance.cpp", {"wf_signed_distances": (None, arguments)})
