# SPDX-License-Identifier: MIT
"""Contact of the objects' surfaces with obstacles and with each other, with friction.

Each surface node is kept away from what it touches by a force that grows as it comes nearer than a thickness d::

    lambda = max(0, k (d - g)),    |tau| <= mu lambda

with the distance g at the end of the step, so the force is implicit, and a traction tau that sticks like a spring of
the same stiffness k until friction mu is overcome. k is `stiffness` times the node's own, (mass + its block of A) over
the time step squared, taken in the first step and kept: with the default of 1 a body at rest stays about d away.

In each step a node gets a plane that stands for an obstacle, for two obstacles at most: where its path under gravity
first comes nearer than d, on the side from which it comes, so that no speed takes it through a thin plate; otherwise at
the nearest point, if that is nearer than 2 d. Obstacles (`[[obstacle]]`) are fixed, move along keyframes, or go to the
poses that a client gives, no faster than `max_speed` and `max_turn`.

With `between` a node is kept away from the triangles of other objects in the same way; what touches is solved as one
system (kernels/pair_detection.cuh, backends/cpu/native/island.h).

Triangles and edges of the surfaces are kept out, too, where something small comes between their nodes
(kernels/face_detection.cuh, edge_detection.cuh).
Friction of a pair is the geometric mean of both, unless `friction` names the pair.

Usual values: a thickness of a tenth of the shortest edge of the surface (the default); friction 0.1 (wet tissue on
steel) to 1 (rubber).
"""

import logging
from collections.abc import Callable, Sequence
from math import hypot
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.contact import Contact as ContactInput
from sim_server.backends.contact import Faces, Obstacles, OwnSurfaces, Surfaces
from sim_server.backends.declarations import Declarations
from sim_server.effects._base import EffectUpdates
from sim_server.effects._movable import Movable, pose_of
from sim_server.errors import InputError
from sim_server.mechanics.signed_distance import closed_surface, signed_distance_grid, signed_distances
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.ties import make_ties
from sim_server.mechanics.world import Body, World
from sim_server.mesh.box_tree import box_tree
from sim_server.mesh.own_surface import edges_through_triangles, nearby_nodes
from sim_server.mesh.surface import edge_owners, surface_edges, surface_triangles
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.parameters import NotNegative, Parameters, Positive, as_tuple

log = logging.getLogger(__name__)

SCOPE = "scene"
TEXT = "effects/contact.cu"
SAMPLES = 6  # of an edge, where triangles are looked at for obstacles at the start
FREE_AT_REST = 2.0  # thicknesses: parts of a body nearer than that at rest do not touch each other
DEFAULT_THICKNESS, LARGEST_THICKNESS = 0.1, 0.5  # of the shortest edge of a surface

ShapeKind = Declarations("kernels/shapes.cuh").enumeration("ShapeKind")


class PairFriction(Parameters):
    """Friction of one object on an obstacle, or on another object."""

    between: Annotated[tuple[str, str], BeforeValidator(as_tuple)] = Field(
        description="an object, and an obstacle or another object"
    )
    value: NotNegative = Field(description="coefficient [-]")


class Params(Parameters):
    thickness: Positive | None = Field(
        default=None, description="distance kept from obstacles [m]; a tenth of the shortest edge of each surface"
    )
    stiffness: float = Field(default=1.0, gt=0, le=1e4, description="of a contact over that of its node [-]")
    passes: int = Field(default=16, ge=1, le=1000, description="most solves of a linearization")
    tolerance: float = Field(default=1e-3, gt=0, lt=1, description="of the contact residual over the right-hand side")
    friction: Annotated[list[PairFriction] | None, Live()] = Field(
        default=None, description="of pairs, instead of the geometric mean"
    )
    between: bool = Field(default=True, description="objects touch each other, too")
    self: bool = Field(default=False, description="objects touch themselves, too")


class Contact(Movable):
    """Obstacles of a scene, and two rows for each free surface node: the obstacles that it may touch in a step.

    dropped (surface nodes,): how often an obstacle found no row since there were nearer ones
    frames (keyframes, 7): poses of the keyframes of all obstacles
    """

    def __init__(self, world: World, params: Params):
        self.params = params
        self.obstacles: Sequence[Obstacle] = world.obstacles
        frames = [[(k.time, pose_of(k)) for k in o.keyframes or ()] or [(0.0, pose_of(o.pose))] for o in self.obstacles]
        super().__init__(world, "obstacle", self.obstacles, frames)
        surfaces = [_surface(world, body) for body in world.bodies]
        self.node = np.concatenate(surfaces)
        self._free = world.free if world.touchable is None else world.touchable
        self.body = np.repeat(np.arange(len(surfaces), dtype=np.int32), [len(s) for s in surfaces])
        bounds = [_thickness(params, body) for body in world.bodies]
        self._shapes(max(bounds))
        self.dropped = np.zeros(len(self.node), np.int32)
        self._pair_friction = world.follow("friction", "contact", compute=_pair_friction)
        touching = params.self or (len(world.bodies) > 1 and params.between)
        ties = make_ties(world)
        start = np.concatenate([[0], np.cumsum([2 * len(s) for s in surfaces])]).astype(np.int32)
        faces = faces_of(world, self._pair_friction, int(start[-1]))
        pairs = int(faces.start[-1] if faces else start[-1]) + int(start[-1])  # the row after those of nodes and bodies
        surfaces_of = _surfaces(world, params, self.node, self.body, pairs, bounds) if touching else None
        body = [np.repeat(self.body, 2), _body_of_rows(faces.start) if faces else ()]
        body += [body[0], _body_of_rows(surfaces_of.edge_start)] if surfaces_of else []
        thickness = np.array(bounds)[np.concatenate(body).astype(np.int32)]
        own = len(thickness)  # rows of contact; those of attachments and springs follow
        ties_of = ties.body[:, 0] if ties else np.zeros(0, np.int32)
        self._row_body, self._first_pair = np.concatenate([*body, ties_of]).astype(np.int32), pairs - int(start[-1])
        thickness = np.concatenate([thickness, np.zeros(len(ties.corner) if ties else 0)])
        rows = len(thickness)
        corner, weight = np.full((rows, 4), -1, np.int32), np.zeros((rows, 4))
        corner[: start[-1], 0] = np.repeat(self.node, 2)
        weight[:, 0] = 1
        if ties:
            corner[own:], weight[own:] = ties.corner, ties.weight
        self._input = ContactInput(
            self._table, start, corner, weight, np.full(rows, -1, np.int32), np.zeros((rows, 3)), np.zeros(rows),
            np.zeros((rows, 3)), np.full(rows, 2.0), np.zeros(rows), np.zeros(rows),
            thickness, np.ones(rows), np.zeros(rows), np.zeros((rows, 3)),
            world.v, self._free, world.mass, world.dt, world.dt, params.passes, params.tolerance, self.dropped, faces,
            surfaces_of, ties,
        )  # fmt: skip
        arrays = [*vars(self).values(), *vars(self._table).values(), *vars(self._input).values()]
        world.backend.keep(*(a for a in arrays if isinstance(a, np.ndarray)), exact=True)

    def cuttable(self, body: Body) -> bool:
        """Returns whether obstacles are all that there is to touch."""
        return self._input.surfaces is None

    def _shapes(self, thickness: float) -> None:
        """Makes the table of shapes, and spheres around them."""
        m = len(self.obstacles)
        size, grids, place = np.zeros((m, 4)), [np.zeros(0)], np.zeros(m, np.int32)
        nodes = np.zeros((m, 3), np.int32)
        for k, o in enumerate(self.obstacles):
            if o.shape == "grid":
                grid = _grid(o, thickness)
                size[k], nodes[k], place[k] = [*grid.first, grid.spacing], grid.values.shape, sum(map(len, grids))
                self.ball[k] = [*grid.center, grid.radius]
                grids.append(grid.values.ravel())
            else:
                size[k], self.ball[k, 3] = _size(o)
        kind = np.array([ShapeKind[o.shape.upper()] for o in self.obstacles], np.int32)
        self._table = Obstacles(kind, size, np.concatenate(grids), place, nodes, self.begin, self.end)

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        """Rows of a body, and of other bodies that it touches in this step."""
        if not any(array is each for each in vars(self._input).values()) or len(array) != len(self._input.obstacle):
            return None
        return self._rows_of

    def _rows_of(self, body: int) -> Any:
        rows = np.flatnonzero(self.world.backend.fetch(self._input.obstacle) == body)
        others = rows[rows >= self._first_pair]
        return np.union1d(np.flatnonzero(self._row_body == body), others)

    def contact_input(self) -> ContactInput:
        """Returns the rows, which the launches fill in each step, and options of the solve."""
        return self._input

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w, rows, table = self.world, self._input, self._table
        gravity, block_scale = w.gravity(), w.euler_block_scale()
        w.backend.keep(gravity, block_scale, exact=True)
        detect = w.backend.module(TEXT).bind(
            "detect", len(self.node), obstacles=len(self.obstacles), **vars(table), swept=self.swept,
            pair_friction=self._pair_friction, node=self.node, body=self.body, x=w.x, predictor=w.v, free=self._free,
            mass=w.mass, block=system.block, block_scale=block_scale, gravity=gravity, force_coefficient=w.dt,
            dx_dv=w.dt, kappa=self.params.stiffness, thickness=rows.thickness, obstacle=rows.obstacle,
            normal=rows.normal, gap=rows.gap, drift=rows.drift, entry=rows.entry, stiffness=rows.stiffness,
            friction=rows.friction, hardening=rows.hardening, force=rows.force, traction=rows.traction,
            dropped=self.dropped,
        )  # fmt: skip
        return [self.place(system), detect]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch]:
        return []  # contacts are detected once a step

    def connect(self, simulation: EffectUpdates) -> None:
        super().connect(simulation)
        self._warn_of_nodes_inside()
        if self._input.faces:
            self._warn_of_triangles_inside(self._input.faces)
        if self._input.surfaces and self.params.between:
            self._warn_of_bodies_inside()
        if self._input.surfaces and self.params.self:
            self._warn_of_bodies_through_themselves(self._input.surfaces)

    def _warn_of_nodes_inside(self) -> None:
        """Logs which objects begin deeper in an obstacle than their thickness: they are pushed out, fast."""
        w, n = self.world, len(self.node)
        distance, nearest = self._distances(self.node, w.x)
        inside = distance < -self._input.thickness[: 2 * n : 2]
        for body in w.bodies:
            if (found := np.flatnonzero(inside & (self.body == body.index))).size:
                worst = found[distance[found].argmin()]
                log.warning(
                    "object %r begins inside obstacle %r: node %d is %.3g m deep (%d such nodes); it is thrown out",
                    body.name, self.obstacles[nearest[worst]].name, self.node[worst] - body.first, -distance[worst],
                    found.size,
                )  # fmt: skip

    def _distances(self, node: Int32, x: Float64) -> tuple[Float64, Int32]:
        """Returns the distance of each point x[node] from the nearest obstacle, and which that is."""
        n = len(node)
        launch = self.world.backend.module(TEXT).bind(
            "distances", n, obstacles=len(self.obstacles), **vars(self._table), node=node, x=x,
            distance=np.zeros(n), nearest=np.zeros(n, np.int32),
        )  # fmt: skip
        launch()
        return launch.fetch("distance"), launch.fetch("nearest")

    def _warn_of_triangles_inside(self, faces: Faces) -> None:
        """Logs which objects begin deeper in an obstacle between their nodes than their thickness, by samples."""
        w, u, v = self.world, *np.indices((SAMPLES + 1, SAMPLES + 1)) / SAMPLES
        weights = np.stack([1 - u - v, u, v], axis=-1)[u + v <= 1 + 1e-9]
        for body in w.bodies:
            triangle = faces.triangle[slice(*(faces.start[body.index : body.index + 2] - faces.start[0]))]
            if not len(triangle):
                continue  # it may be cut, and touches with its nodes alone
            points = np.einsum("sa,tak->tsk", weights, w.x[triangle]).reshape(-1, 3)
            distance, nearest = self._distances(np.arange(len(points), dtype=np.int32), points)
            deep = distance.reshape(len(triangle), -1) < -_thickness(self.params, body)
            between = deep.any(axis=1) & ~deep[:, (weights == 1).any(axis=1)].any(axis=1)  # nodes have been told
            if found := int(np.count_nonzero(between)):
                worst = int(np.where(np.repeat(between, len(weights)), distance, np.inf).argmin())
                log.warning(
                    "object %r begins inside obstacle %r between its nodes: %.3g m deep (%d such triangles); it is "
                    "thrown out", body.name, self.obstacles[nearest[worst]].name, -distance[worst], found,
                )  # fmt: skip

    def _warn_of_bodies_inside(self) -> None:
        """Logs which objects begin deeper in another one than their thickness: they are pushed out, or stay inside."""
        w = self.world
        for other in w.bodies:
            corners, low, high = None, w.x[other.nodes].min(axis=0), w.x[other.nodes].max(axis=0)
            for body in w.bodies:
                nodes = self.node[self.body == body.index]
                nodes = nodes[((w.x[nodes] > low) & (w.x[nodes] < high)).all(axis=1)]
                if body is other or not len(nodes):
                    continue
                try:
                    corners = corners or closed_surface(w.x, surface_triangles(other.mesh.tets) + np.int64(other.first))
                except InputError:
                    break  # its sides cannot be told
                distance = signed_distances(corners, w.x[nodes])
                worst = int(distance.argmin())
                found = int(np.count_nonzero(distance < -_thickness(self.params, body)))
                if found:
                    log.warning(
                        "object %r begins inside object %r: node %d is %.3g m deep (%d such nodes)",
                        body.name, other.name, nodes[worst] - body.first, -distance[worst], found,
                    )  # fmt: skip

    def _warn_of_bodies_through_themselves(self, surfaces: Surfaces) -> None:
        """Logs which objects begin with edges through their own surface: what is through stays so."""
        first = (surfaces.edge_start - surfaces.edge_start[0]) // 2
        for body in self.world.bodies:
            own = (surfaces.triangle[:, 0] >= body.first) & (surfaces.triangle[:, 0] < body.last)
            edges = surfaces.edge[first[body.index] : first[body.index + 1]]
            if (found := np.unique(edges_through_triangles(self.world.x, edges, surfaces.triangle[own])[0])).size:
                one, other = edges[found[0]] - body.first
                log.warning(
                    "object %r begins passing through itself: the edge from node %d to %d goes through its surface (%d "
                    "such edges)", body.name, one, other, found.size,
                )  # fmt: skip


def _surface(world: World, body: Body) -> Int32:
    """Returns the free nodes of a body's surface, in numbers of the scene, ascending; all of one that may be cut."""
    nodes = np.unique(body.mesh.tets if "cutting" in body.effects else surface_triangles(body.mesh.tets)) + body.first
    return nodes[world.free[nodes] > 0].astype(np.int32)


def faces_of(world: World, friction: Float64, first: int) -> Faces | None:
    """Returns the triangles that need rows against obstacles, the first of which is `first`.

    None where there are none: corners are enough against planes, and are all that touches of an object that may be cut.
    """
    if all(o.shape == "plane" for o in world.obstacles) or all("cutting" in b.effects for b in world.bodies):
        return None
    triangles = [_triangles_with_rows(b) + np.int32(b.first) for b in world.bodies]
    start = first + np.cumsum([0, *map(len, triangles)])
    triangle = np.concatenate(triangles).astype(np.int32)
    return Faces(start.astype(np.int32), triangle, edge_owners(triangle), friction, world.gravity())


def _triangles_with_rows(body: Body) -> Int32:
    return np.zeros((0, 3), np.int32) if "cutting" in body.effects else surface_triangles(body.mesh.tets)


def _body_of_rows(start: Int32) -> Int32:
    """Returns the body of each row from start[0] on."""
    return np.repeat(np.arange(len(start) - 1, dtype=np.int32), np.diff(start))


def _surfaces(
    world: World, params: Params, node: Int32, body: Int32, first: int, thickness: Sequence[float]
) -> Surfaces:  # fmt: skip
    """Returns what bodies need to touch each other.

    node, body: surface nodes and their bodies. first: row of the first edge. thickness: of each body [m]
    """
    site = np.full(world.nodes, -1, np.int32)
    site[node] = np.arange(len(node), dtype=np.int32)
    triangles = [surface_triangles(b.mesh.tets) + np.int32(b.first) for b in world.bodies]
    trees = [box_tree(world.rest[t].mean(axis=1)) for t in triangles]
    boxes, first_triangle = np.cumsum([0, *map(len, trees)]), np.cumsum([0, *map(len, triangles)])
    shifted = [np.where(t < 0, t - k, t + box) for t, box, k in zip(trees, boxes, first_triangle, strict=False)]
    triangle = np.concatenate(triangles).astype(np.int32)
    edge, opposite, of_triangle = surface_edges(triangle)
    length = np.linalg.norm(world.rest[edge[:, 0]] - world.rest[edge[:, 1]], axis=1)
    ends = np.concatenate([[0], np.cumsum((of_triangle >= 0).sum(axis=1))])[first_triangle]
    mean = np.add.reduceat(length, ends[:-1]) / np.diff(ends)
    return Surfaces(
        body, site, triangle, boxes.astype(np.int32), np.concatenate(shifted).astype(np.int32),
        (first + 2 * ends).astype(np.int32), edge, opposite, of_triangle, mean, np.array(thickness),
        world.follow("friction", "contact", compute=lambda scene: _friction_of_bodies(world, scene)), world.gravity(),
        params.between,
        _own_surfaces(world, triangles, thickness) if params.self else None,
    )  # fmt: skip


def _own_surfaces(world: World, triangles: Sequence[Int32], thickness: Sequence[float]) -> OwnSurfaces:
    """Returns what bodies need to touch themselves. triangles, thickness: of each body, in nodes of the scene; [m]"""
    ends, near = [np.zeros(1, np.int64)], [np.zeros(0, np.int32)]
    for body, own, d in zip(world.bodies, triangles, thickness, strict=True):
        start, node = nearby_nodes(body.mesh.tets, body.mesh.rest, own - np.int32(body.first), FREE_AT_REST * d)
        ends.append(start[1:] + ends[-1][-1])
        near.append(node + np.int32(body.first))
    nodes = [np.unique(t).astype(np.int32) for t in triangles]
    return OwnSurfaces(
        np.concatenate(ends).astype(np.int32), np.concatenate(near),
        np.cumsum([0, *map(len, nodes)]).astype(np.int32), np.concatenate(nodes),
    )  # fmt: skip


def _friction_of_bodies(world: World, scene: Scene) -> Float64:
    """Returns the coefficient of each body on each other, (bodies, bodies)."""
    own = [(o.name, o.friction or 0.0) for o in scene.objects]
    listed = _listed_friction(scene)
    return np.array([[listed.get(frozenset((a, b)), (f * g) ** 0.5) for b, g in own] for a, f in own])


def _listed_friction(scene: Scene) -> dict[frozenset[str], float]:
    pairs = scene.effects["contact"].friction or ()  # type: ignore[attr-defined]
    return {frozenset(pair.between): pair.value for pair in pairs}


def _thickness(params: Params, body: Body) -> float:
    """Returns the thickness of a body's surface [m]; raises InputError if it is too large."""
    corners = body.mesh.rest[surface_triangles(body.mesh.tets)]
    shortest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min())
    if params.thickness is None:
        return DEFAULT_THICKNESS * shortest
    if params.thickness > LARGEST_THICKNESS * shortest:
        raise InputError(
            f"effects.contact.thickness = {params.thickness:g} m: at most {LARGEST_THICKNESS * shortest:.4g} m, half "
            f"of the shortest edge of the surface of object {body.name!r}"
        )
    return params.thickness


def _grid(o: Obstacle, thickness: float) -> Any:
    assert o.file is not None and o.spacing is not None
    try:
        return signed_distance_grid(o.file, o.scale or 1.0, o.spacing, 3 * thickness)
    except InputError as error:
        raise InputError(f"obstacle {o.name!r}: {error}") from None


def _size(o: Obstacle) -> tuple[list[float], float]:
    """Returns the size of a shape as kernels have it, (4,), and the radius of the sphere around it; -1: without end."""
    if o.shape == "plane":
        return [0.0] * 4, -1.0
    if o.shape == "box":
        assert o.size is not None
        half = [s / 2 for s in o.size]
        return [*half, 0.0], hypot(*half)
    assert o.radius is not None
    half_axis = (o.length or 0.0) / 2
    return [o.radius, half_axis, 0.0, 0.0], o.radius + half_axis


def _pair_friction(scene: Scene) -> Float64:
    """Returns the coefficient of each body on each obstacle, (bodies, m)."""
    listed = _listed_friction(scene)
    bodies, obstacles = [(o.name, o.friction or 0.0) for o in scene.objects], scene.obstacles or []
    return np.array([
        [listed.get(frozenset((name, o.name)), (friction * o.friction) ** 0.5) for o in obstacles]
        for name, friction in bodies
    ])  # fmt: skip


def build(world: World, listed: list[tuple[Body, Any]]) -> Contact:
    """Raises InputError for a thickness or a surface of an obstacle that cannot be used."""
    return Contact(world, listed[0][1])
