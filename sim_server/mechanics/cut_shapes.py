# SPDX-License-Identifier: MIT
"""Which elements a cut takes: those that a swept blade meets, those in a sphere, those that are torn."""

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.mesh.surface import EDGES, FACES

Bools = NDArray[np.bool_]
ROUNDING = 1e-9  # of coordinates, by which a corner may seem to be on the wrong side of a plane


def met_by_blade(x: Float64, tets: Int32, corners: Float64) -> Int64:
    """Returns the numbers of the elements that a surface meets or touches.

    x (n, 3), tets (m, 4): nodes [m] and elements. corners (3, 3) or (4, 3): of a triangle, or of a quadrangle as two
    """
    low, high = corners.min(axis=0), corners.max(axis=0)
    beyond = np.concatenate([x < low, x > high], axis=1) @ np.array([1, 2, 4, 8, 16, 32], np.uint8)
    near = np.flatnonzero(np.bitwise_and.reduce(beyond[tets], axis=1) == 0)  # not all four beyond one side of its box
    points = x[tets[near]]
    triangles = [corners[[0, 1, 2]], *([corners[[0, 2, 3]]] if len(corners) == 4 else [])]
    met = np.zeros(len(near), bool)
    for triangle in triangles:
        across = np.flatnonzero(_across(points, triangle))
        met[across] |= _meet(points[across], triangle)
    return near[met]


def opened_by_blade(x: Float64, tets: Int32, owners: Int64, corners: Float64) -> Int64:
    """Returns the numbers of the faces between elements that a surface meets and those on its other side.

    An element is on the side of its centroid, by the triangle of the surface that it is beside; of the two elements of
    such a face one at least meets the surface. owners (f, 2): elements of each face, -1: there is none
    """
    met = np.zeros(len(tets) + 1, bool)
    met[met_by_blade(x, tets, corners)] = True
    faces = np.flatnonzero((owners >= 0).all(axis=1) & met[owners].any(axis=1))
    side = _sides(x[tets[owners[faces]]].mean(axis=2).reshape(-1, 3), corners).reshape(-1, 2)
    return np.asarray(faces[side[:, 0] != side[:, 1]])


def border(chosen: Bools, owners: Int64) -> Int64:
    """Returns the numbers of the faces between chosen elements (m,) and others."""
    inside = np.append(chosen, False)[owners]
    return np.flatnonzero((owners >= 0).all(axis=1) & (inside[:, 0] != inside[:, 1]))


def _sides(points: Float64, corners: Float64) -> Bools:
    """Returns on which side of a surface points (m, 3) are; of a quadrangle by its triangle on their side of the
    diagonal."""
    triangles = [corners[[0, 1, 2]], *([corners[[0, 2, 3]]] if len(corners) == 4 else [])]
    normals = [np.cross(t[1] - t[0], t[2] - t[0]) for t in triangles]
    heights = np.stack([(points - corners[0]) @ normal for normal in normals])
    if len(triangles) == 1:
        return np.asarray(heights[0] > 0)
    across = np.cross(normals[0] + normals[1], corners[2] - corners[0])
    second = (points - corners[0]) @ across > 0
    return np.asarray(np.where(second, heights[1], heights[0]) > 0)


def in_sphere(x: Float64, tets: Int32, center: Float64, radius: float) -> Int64:
    """Returns the numbers of the elements whose centroids are within `radius` of `center` [m]."""
    return np.flatnonzero(np.linalg.norm(x[tets].mean(axis=1) - center, axis=1) <= radius)


def torn(x: Float64, tets: Int32, gradients: Float64, present: Bools, limit: float) -> Int64:
    """Returns the numbers of the elements whose largest principal stretch is above `limit`, ascending.

    Of those that share a node only the most stretched one: others may hold once it is gone. x (n, 3) [m]; gradients
    (m, 3, 3) of the shape functions of corners 1, 2, 3 [1/m]; present (m,)
    """
    corners = x[tets]
    F = np.einsum("eai,eaj->eij", corners[:, 1:] - corners[:, :1], gradients)
    with np.errstate(over="ignore", invalid="ignore"):
        square = (F**2).sum(axis=(1, 2))  # of all three stretches
    above = np.flatnonzero(present & (square > limit * limit) & (square < np.inf))
    stretch = np.linalg.eigvalsh(F[above].swapaxes(1, 2) @ F[above])[:, 2] ** 0.5
    order = np.argsort(-stretch, kind="stable")
    taken, found = np.zeros(len(x), bool), []
    for element in above[order[stretch[order] > limit]].tolist():
        if not taken[tets[element]].any():
            taken[tets[element]] = True
            found.append(element)
    return np.array(sorted(found), np.int64)


def _across(points: Float64, triangle: Float64) -> Bools:
    """Returns whether tetrahedra (m, 4, 3) have corners on both sides of a triangle's plane, or nearly on it."""
    normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    away = (points - triangle[0]) @ normal
    nearly = ROUNDING * np.linalg.norm(normal) * max(np.abs(points).max(initial=0), np.abs(triangle).max())
    return np.asarray((away.min(axis=1) <= nearly) & (away.max(axis=1) >= -nearly))


def _meet(points: Float64, triangle: Float64) -> Bools:
    """Returns whether tetrahedra (m, 4, 3) meet a triangle (3, 3): an edge of one passes the other, or one holds it."""
    begin, end = points[:, EDGES[:, 0]], points[:, EDGES[:, 1]]
    met = _passes(begin, end, *(np.broadcast_to(corner, begin.shape) for corner in triangle)).any(axis=1)
    faces = points[:, FACES]  # (m, 4, 3, 3)
    for k in range(3):
        a, b = (np.broadcast_to(triangle[j], (*faces.shape[:2], 3)) for j in (k, (k + 1) % 3))
        met |= _passes(a, b, faces[:, :, 0], faces[:, :, 1], faces[:, :, 2]).any(axis=1)
    return met | _inside(points, triangle[0])


def _passes(a: Float64, b: Float64, p: Float64, q: Float64, r: Float64) -> Bools:
    """Returns whether segments a b pass triangles p q r, all (..., 3); one that lies in the plane does not."""
    normal = np.cross(q - p, r - p)
    da, db = ((a - p) * normal).sum(-1), ((b - p) * normal).sum(-1)
    way = np.where(da != db, da - db, 1)
    at = a + (da / way)[..., None] * (b - a)
    inside = np.ones(da.shape, bool)
    for u, v in ((p, q), (q, r), (r, p)):
        inside &= (np.cross(v - u, at - u) * normal).sum(-1) >= 0
    return np.asarray(inside & (da != db) & (da * db <= 0))


def _inside(points: Float64, point: Float64) -> Bools:
    """Returns whether a point (3,) is in tetrahedra (m, 4, 3)."""
    outward = np.ones(len(points), bool)
    for face in FACES:
        a, b, c = points[:, face[0]], points[:, face[1]], points[:, face[2]]
        outward &= (np.cross(b - a, c - a) * (point - a)).sum(-1) <= 0
    return outward
