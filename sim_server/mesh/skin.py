# SPDX-License-Identifier: MIT
"""A fine surface that moves with a coarser tetrahedral mesh: each vertex by barycentric weights of one tetrahedron.

A vertex is a weighted sum of the four corners of the tetrahedron that contains it. Outside the mesh the nearest
tetrahedron is taken, with the weights of its linear functions continued beyond it: an affine motion of the nodes moves
every vertex exactly. Weights are bounded, for those of flat tetrahedra would grow with every deformation.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.errors import InputError
from sim_server.mesh import Mesh
from sim_server.mesh.proximity import triangle_distances, within
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.mesh.surface import FACES, surface_faces
from sim_server.mesh.surface_file import read_surface

log = logging.getLogger(__name__)

MOST_VERTICES = 1_000_000
MOST_OUTSIDE = 0.1  # distance of a vertex from the mesh, of the largest extent of the mesh
MOST_WEIGHT = 4.0  # magnitude of a weight
ROUNDING = 1e-9  # of the largest extent: vertices outside by less are inside
COUNTED = 1e-6  # of the largest extent: vertices outside, or moved, by more are counted
WARNED = 0.05  # of the largest extent: a vertex outside by more is a warning; round parts of a coarse mesh take less
PART = 8192  # vertices that are looked at together


@dataclass(frozen=True)
class Skin:
    """Vertex k is at the sum over c of weights[k, c] x[nodes[k, c]].

    nodes: int32 (s, 4); weights: float64 (s, 4), sums 1; triangles: int32 (t, 3), of vertices
    """

    nodes: Int32
    weights: Float64
    triangles: Int32


def read_skin(path: str | Path, scale: float, mesh: Mesh) -> Skin:
    """Returns the surface in a file that meshio reads, embedded in a mesh. scale: of the coordinates in the file.

    Warns of vertices that lie far outside the mesh, or had to be moved. Raises InputError for a file that has no
    surface, too many vertices, or one that is too far outside.
    """
    points, triangles = read_surface(path, "skin")
    used, numbers = np.unique(triangles, return_inverse=True)
    if len(used) > MOST_VERTICES:
        raise InputError(f"skin {path}: {len(used)} vertices; allowed: at most {MOST_VERTICES}")
    points = points[used] * scale
    try:
        nodes, weights, outside = embed(points, mesh)
    except InputError as error:
        raise InputError(f"skin {path}: {error}") from None
    size = _size(mesh)
    by = np.linalg.norm(np.einsum("sc,scd->sd", weights, mesh.rest[nodes]) - points, axis=1)
    moved = by > COUNTED * size
    if outside.max() > WARNED * size or moved.any():
        log.warning(
            "skin %s: %d of %d vertices lie outside the mesh, up to %.3g m (%.2g %% of its size)%s",
            path, (outside > COUNTED * size).sum(), len(points), outside.max(), 100 * outside.max() / size,
            f"; {moved.sum()} were moved by up to {by.max():.3g} m, since the tetrahedra there are too flat"
            if moved.any() else "",
        )  # fmt: skip
    return Skin(nodes, weights, numbers.reshape(-1, 3).astype(np.int32))


def embed(points: Float64, mesh: Mesh) -> tuple[Int32, Float64, Float64]:
    """Returns nodes (s, 4), weights (s, 4) and the distance from the mesh (s,) [m] of each point (s, 3).

    Raises InputError for a point that is farther outside than MOST_OUTSIDE.
    """
    gradients = _gradients(mesh)
    tet, depth = _deepest(points, mesh, gradients)
    distance, size = np.zeros(len(points)), _size(mesh)
    if (out := np.flatnonzero(~(depth >= -ROUNDING * size))).size:
        tet[out], distance[out] = _nearest(points[out], mesh, MOST_OUTSIDE * size)
    return mesh.tets[tet], _bounded(_weights(points, tet, mesh, gradients)), distance


def contained(points: Float64, mesh: Mesh) -> tuple[Int32, Float64, NDArray[np.bool_]]:
    """Returns nodes (s, 4) and weights (s, 4) of points (s, 3), and which lie in the mesh, (s,)."""
    gradients = _gradients(mesh)
    tet, depth = _deepest(points, mesh, gradients)
    return mesh.tets[tet], _weights(points, tet, mesh, gradients), depth >= -COUNTED * _size(mesh)


def _gradients(mesh: Mesh) -> Float64:
    """Returns the gradients of the barycentric coordinates of all tetrahedra, (m, 4, 3) [1/m]."""
    of_three = shape_gradients(mesh.rest, mesh.tets)[1]
    return np.concatenate([-of_three.sum(axis=1, keepdims=True), of_three], axis=1)


def _size(mesh: Mesh) -> float:
    """Returns the largest extent of a mesh [m]."""
    return float(np.ptp(mesh.rest, axis=0).max())


def _weights(points: Float64, tet: Int64, mesh: Mesh, gradients: Float64) -> Float64:
    """Returns the barycentric coordinates of points in their tetrahedra, (k, 4)."""
    off = points - mesh.rest[mesh.tets[tet, 0]]
    weights = np.einsum("kcd,kd->kc", gradients[tet], off)
    weights[:, 0] = 1 - weights[:, 1:].sum(axis=1)
    return weights


def _deepest(points: Float64, mesh: Mesh, gradients: Float64) -> tuple[Int64, Float64]:
    """Returns for each point the tetrahedron whose faces are farthest outwards of it, among those that may contain it,
    and that distance [m]: negative outside; 0 and -inf where there is none."""
    corners = mesh.rest[mesh.tets]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    height = 1 / np.linalg.norm(gradients, axis=2)
    tet, depth = np.zeros(len(points), np.int64), np.full(len(points), -np.inf)
    octave = np.ceil(np.log2(reach / reach.min()))  # tetrahedra of similar size are looked for together
    for level in np.unique(octave):
        group = np.flatnonzero(octave == level)
        for part in _parts(len(points)):
            point, near = within(points[part], middle[group], reach[group].max() * (1 + ROUNDING))
            if not len(point):
                continue
            here = group[near]
            inside = (_weights(points[part][point], here, mesh, gradients) * height[here]).min(axis=1)
            first, best = _best_of_each(point, inside)
            at = part.start + point[first]
            deeper = inside[best] > depth[at]
            tet[at[deeper]], depth[at[deeper]] = here[best][deeper], inside[best][deeper]
    return tet, depth


def _nearest(points: Float64, mesh: Mesh, most: float) -> tuple[Int64, Float64]:
    """Returns the tetrahedron nearest to each point outside, and the distance [m].

    Raises InputError for a distance above `most`.
    """
    from scipy.spatial import cKDTree

    low, high = mesh.rest.min(axis=0), mesh.rest.max(axis=0)
    _check_distances(points, np.linalg.norm(points - np.clip(points, low, high), axis=1), most)
    faces = surface_faces(mesh.tets)
    corners = mesh.rest[mesh.tets[:, FACES].reshape(-1, 3)[faces]]
    middle = corners.mean(axis=1)
    reach = float(np.linalg.norm(corners - middle[:, None], axis=2).max())
    to_middle = np.asarray(cKDTree(middle).query(points)[0])
    _check_distances(points, to_middle - reach, most)
    tet, distance = np.zeros(len(points), np.int64), np.zeros(len(points))
    for part in _parts(len(points)):
        point, near = within(points[part], middle, to_middle[part] + reach)
        apart = triangle_distances(points[part][point], corners[near])
        _, best = _best_of_each(point, -apart)
        tet[part], distance[part] = faces[near[best]] // 4, apart[best]
    _check_distances(points, distance, most)
    return tet, distance


def _check_distances(points: Float64, distance: Float64, most: float) -> None:
    """Raises InputError for a point that is farther from the mesh than `most` [m]. distance: or a lower bound of it."""
    if (far := np.flatnonzero(distance > most)).size:
        worst = int(distance.argmax())
        place = ", ".join(f"{c:.4g}" for c in points[worst])
        raise InputError(
            f"a vertex at ({place}) m lies {distance[worst]:.3g} m or more outside the mesh ({far.size} such "
            f"vertices); allowed: {most:.3g} m, {MOST_OUTSIDE:.0%} of its size. A skin has the unit and the place of "
            "the mesh before the pose"
        )


def _bounded(weights: Float64) -> Float64:
    """Returns weights with magnitudes up to MOST_WEIGHT: those that exceed it are moved towards the tetrahedron."""
    wild = np.flatnonzero((abs(weights) > MOST_WEIGHT).any(axis=1))
    given = weights[wild]
    near = np.clip(given, 0, None)
    near /= near.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.copysign(MOST_WEIGHT, given) - near) / (given - near)
    share = np.where(abs(given) > MOST_WEIGHT, share, 1).min(axis=1, keepdims=True)
    weights[wild] = near + share * (given - near)
    return weights


def _best_of_each(point: Int64, value: Float64) -> tuple[Int64, Int64]:
    """Returns, for each run of equal numbers in `point`, its begin and the first place of its largest value."""
    begin = np.flatnonzero(np.diff(point, prepend=-1))
    most = np.repeat(np.maximum.reduceat(value, begin), np.diff(begin, append=len(point)))
    best = np.flatnonzero(value == most)
    return begin, best[np.searchsorted(best, begin)]


def _parts(count: int) -> Iterator[slice]:
    """Yields slices of at most PART out of `count`."""
    return (slice(k, min(k + PART, count)) for k in range(0, count, PART))
