# SPDX-License-Identifier: MIT
"""Makes the rows of attachments and springs ([[attachment]], [[spring]]) of a scene."""

from typing import NamedTuple

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.contact import Contact, Obstacles
from sim_server.backends.ties import Ties
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.mesh.surface import surface_triangles
from sim_server.scene import where
from sim_server.scene.pose import quaternion
from sim_server.scene.ties import Attachment, Spring, SpringEnd

REACH = 0.5  # of the shortest edge of a surface: how far a node that is attached to it may be


class _Row(NamedTuple):
    corner: list[int]
    weight: list[float]
    body: tuple[int, int]
    obstacle: int
    point: Float64
    table: int
    kappa: float
    rest: float
    stiffness: float
    breaking: float


def make_ties(world: World) -> Ties | None:
    """Returns the rows of all attachments and springs; None if there are none. Raises InputError."""
    tables: list[Attachment | Spring] = [*world.attachments, *world.springs]
    if not tables:
        return None
    rows: list[_Row] = []
    for number, table in enumerate(tables):
        rows += _attached(world, number, table) if isinstance(table, Attachment) else [_spring(world, number, table)]
    rows.sort(key=lambda row: row.body[0])
    n = len(rows)
    corner, weight = np.full((n, 4), -1, np.int32), np.zeros((n, 4))
    for k, row in enumerate(rows):
        corner[k, : len(row.corner)], weight[k, : len(row.corner)] = row.corner, row.weight
    return Ties(
        corner, weight, np.array([r.body for r in rows], np.int32), np.array([r.obstacle for r in rows], np.int32),
        np.array([r.point for r in rows]), np.array([r.table for r in rows], np.int32), len(tables),
        np.array([r.kappa for r in rows]), np.array([r.rest for r in rows]), np.array([r.breaking for r in rows]),
        np.array([r.stiffness for r in rows]), np.zeros((n, 3)), np.zeros(n, np.int32), world.reaction,
        len(world.holders),
    )  # fmt: skip


def ties_alone(world: World, ties: Ties) -> Contact:
    """Returns the input of an engine for attachments and springs in a scene without contact."""
    n, m = len(ties.corner), len(world.bodies)
    none = np.zeros(0, np.int32)
    shapes = Obstacles(none, np.zeros((0, 4)), np.zeros(1), none, np.zeros((0, 3), np.int32), *np.zeros((2, 0, 7)))
    zeros, vectors = (np.zeros(n) for _ in range(5)), (np.zeros((n, 3)) for _ in range(3))
    return Contact(
        shapes, np.zeros(m + 1, np.int32), ties.corner, ties.weight, np.full(n, -1, np.int32), next(vectors),
        next(zeros), next(vectors), np.full(n, 2.0), next(zeros), next(zeros), next(zeros), np.ones(n),
        next(zeros), next(vectors), world.predictor, world.free, world.mass, world.dx_dv, world.force_coefficient, 16,
        1e-3, none, None, None, ties,
    )  # fmt: skip


def _attached(world: World, number: int, a: Attachment) -> list[_Row]:
    body = world.body(a.object)
    nodes = np.flatnonzero(where.nodes(a.where, body.mesh)) + body.first
    if not len(nodes):
        raise InputError(f"attachment {a.name!r}: where = {a.where!r} has no node of object {a.object!r}")
    given = (number, a.stiffness, 0.0, 0.0, a.breaking or np.inf)
    obstacles = [o.name for o in world.obstacles]
    if a.to in obstacles:
        points = _local_points(world, obstacles.index(a.to), world.x[nodes])
        return [
            _Row([int(node)], [1.0], (body.index, -1), obstacles.index(a.to), point, *given)
            for node, point in zip(nodes, points, strict=True)
        ]
    other = world.body(a.to)
    corners, weights = _nearest_points(world, other, world.x[nodes], a)
    rows = []
    for node, corner, weight in zip(nodes, corners, weights, strict=True):
        some = weight > 1e-9
        near, share = corner[some].tolist(), (-weight[some] / weight[some].sum()).tolist()
        rows.append(_Row([int(node), *near], [1.0, *share], (body.index, other.index), -1, np.zeros(3), *given))
    return rows


def _nearest_points(world: World, other: Body, x: Float64, a: Attachment) -> tuple[Int32, Float64]:
    """Returns corners (n, 3) and weights (n, 3) of the points of a surface that are nearest to x. Raises InputError."""
    triangles = surface_triangles(other.mesh.tets) + np.int32(other.first)
    p = world.x[triangles]
    found = [nearest_on_triangles(point, p) for point in x]
    best = np.array([int(d.argmin()) for _, d in found])
    weights = np.array([w[k] for (w, _), k in zip(found, best, strict=True)])
    distance = np.array([d[k] for (_, d), k in zip(found, best, strict=True)])
    reach = a.reach or REACH * float(np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).min())
    if (far := distance.max()) > reach:
        raise InputError(
            f"attachment {a.name!r}: a node of object {a.object!r} is {far:.4g} m from the surface of {a.to!r}; at "
            f"most reach = {reach:.4g} m, since what is attached is drawn together"
        )
    return triangles[best], weights


def nearest_on_triangles(x: Float64, p: Float64) -> tuple[Float64, Float64]:
    """Returns barycentric weights (m, 3) of the points of triangles p (m, 3, 3) that are nearest to x, and distances.

    Source: Ericson, Real-Time Collision Detection, section 5.1.5.
    """
    a, b, c = p[:, 0], p[:, 1], p[:, 2]
    inside = _inside(x, a, b, c)
    options = [inside]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = p[:, j] - p[:, i]
        s = np.clip(((x - p[:, i]) * edge).sum(axis=1) / (edge**2).sum(axis=1), 0, 1)
        w = np.zeros((len(p), 3))
        w[:, i], w[:, j] = 1 - s, s
        options.append(w)
    points = np.stack([np.einsum("mk,mkx->mx", w, p) for w in options])
    distance = np.linalg.norm(points - x, axis=2)
    distance[0][(inside < 0).any(axis=1)] = np.inf
    best = distance.argmin(axis=0)
    rows = np.arange(len(p))
    return np.stack(options)[best, rows], distance[best, rows]


def _inside(x: Float64, a: Float64, b: Float64, c: Float64) -> Float64:
    """Barycentric weights (m, 3) of the projection of x onto the planes of triangles."""
    u, v, w = b - a, c - a, x - a
    uu, uv, vv = (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)
    wu, wv, area = (w * u).sum(axis=1), (w * v).sum(axis=1), 0.0
    area = uu * vv - uv**2
    s, t = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
    found: Float64 = np.stack([1 - s - t, s, t], axis=1)
    return found


def _local_points(world: World, obstacle: int, x: Float64) -> Float64:
    """Returns points of the scene in the frame of an obstacle where that begins."""
    o = world.obstacles[obstacle]
    pose = o.keyframes[0] if o.keyframes else o.pose
    w, *v = quaternion(pose.rotate)
    away, axis = x - np.array(pose.translate), -np.array(v)
    turn = 2 * np.cross(axis, away)
    points: Float64 = away + w * turn + np.cross(axis, turn)
    return points


def _spring(world: World, number: int, s: Spring) -> _Row:
    (first, a), (second, b) = (_end(world, s, end) for end in s.between)
    if first == second:
        raise InputError(f"spring {s.name!r}: both ends are node {first}; it needs two")
    rest = float(np.linalg.norm(world.x[first] - world.x[second])) if s.rest_length is None else s.rest_length
    ends = (a.index, b.index)
    return _Row(
        [first, second], [1.0, -1.0], ends, -1, np.zeros(3), number, 0.0, rest, s.stiffness, s.breaking or np.inf
    )  # fmt: skip


def _end(world: World, s: Spring, end: SpringEnd) -> tuple[int, Body]:
    body = world.body(end.object)
    return body.first + int(np.linalg.norm(body.mesh.rest - np.array(end.at), axis=1).argmin()), body
