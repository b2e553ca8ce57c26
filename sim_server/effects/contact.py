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

Only nodes are kept out: a corner or an edge that is smaller than the triangles of the surface may pass between them.
Friction of a pair is the geometric mean of both, unless `friction` names the pair.

Usual values: a thickness of a tenth of the shortest edge of the surface (the default); friction 0.1 (wet tissue on
steel) to 1 (rubber).
"""

import logging
from collections.abc import Sequence
from math import dist, hypot
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.contact import Contact as ContactInput
from sim_server.backends.contact import Obstacles, Surfaces
from sim_server.backends.declarations import Declarations
from sim_server.effects._base import Effect, EffectUpdates
from sim_server.errors import InputError
from sim_server.mechanics.signed_distance import signed_distance_grid
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.box_tree import box_tree
from sim_server.mesh.surface import surface_triangles
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.parameters import NotNegative, Parameters, Positive, as_tuple
from sim_server.scene.pose import quaternion

log = logging.getLogger(__name__)

SCOPE = "scene"
TEXT = "effects/contact.cu"
REACH = 1e3  # sizes of the scene: how far from it a client's pose may be
DEFAULT_THICKNESS, LARGEST_THICKNESS = 0.1, 0.5  # of the shortest edge of a surface

ShapeKind = Declarations("kernels/shapes.cuh").enumeration("ShapeKind")
MOTION = {"fixed": 0, "keyframes": 1, "client": 2}  # Motion of contact.cu


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
    passes: int = Field(default=16, ge=1, le=1000, description="most solves of a step")
    tolerance: float = Field(default=1e-3, gt=0, lt=1, description="of the contact residual over the right-hand side")
    friction: list[PairFriction] | None = Field(default=None, description="of pairs, instead of the geometric mean")
    between: bool = Field(default=True, description="objects touch each other, too")


class ContactError(ValueError):
    """A pose that is refused; the text is for the client."""


Point = tuple[float, float, float]
Rotation = tuple[float, float, float, float]


class Contact(Effect):
    """Obstacles of a scene, and two rows for each free surface node: the obstacles that it may touch in a step.

    dropped (surface nodes,): how often an obstacle found no row since there were nearer ones
    frames (keyframes, 7): poses of the keyframes of all obstacles
    """

    def __init__(self, world: World, params: Params):
        self.world, self.params = world, params
        self.obstacles: Sequence[Obstacle] = world.obstacles
        self._simulation: EffectUpdates | None = None
        self._system: System | None = None
        low, high = world.x.min(axis=0), world.x.max(axis=0)
        self._center, self._size = (low + high) / 2, float(np.linalg.norm(high - low))
        surfaces = [_surface(world, body) for body in world.bodies]
        self.node = np.concatenate(surfaces)
        self.body = np.repeat(np.arange(len(surfaces), dtype=np.int32), [len(s) for s in surfaces])
        bounds = [_thickness(params, body) for body in world.bodies]
        self._shapes(max(bounds))
        self._poses()
        touching = len(world.bodies) > 1 and params.between
        rows = (4 if touching else 2) * len(self.node)
        corner, weight = np.full((rows, 4), -1, np.int32), np.zeros((rows, 4))
        corner[: 2 * len(self.node), 0] = np.repeat(self.node, 2)
        weight[:, 0] = 1
        thickness = np.tile(np.repeat(np.array(bounds)[self.body], 2), 2 if touching else 1)
        start = np.concatenate([[0], np.cumsum([2 * len(s) for s in surfaces])]).astype(np.int32)
        self._input = ContactInput(
            self._table, start, corner, weight, np.full(rows, -1, np.int32), np.zeros((rows, 3)), np.zeros(rows),
            np.zeros((rows, 3)), np.full(rows, 2.0), np.zeros(rows), np.zeros(rows),
            thickness, np.zeros(rows), np.zeros((rows, 3)),
            world.predictor, world.free, world.dx_dv, world.force_coefficient, params.passes, params.tolerance,
            _surfaces(world, params, self.node, self.body) if touching else None,
        )  # fmt: skip
        self.dropped = np.zeros(len(self.node), np.int32)
        self._pair_friction = _pair_friction(world, params)
        arrays = [*vars(self).values(), *vars(self._table).values(), *vars(self._input).values()]
        world.backend.keep(*(a for a in arrays if isinstance(a, np.ndarray)), exact=True)

    def _shapes(self, thickness: float) -> None:
        """Makes the table of shapes, and spheres around them."""
        m = len(self.obstacles)
        size, self._ball, grids, place = np.zeros((m, 4)), np.zeros((m, 4)), [np.zeros(0)], np.zeros(m, np.int32)
        nodes = np.zeros((m, 3), np.int32)
        for k, o in enumerate(self.obstacles):
            if o.shape == "grid":
                grid = _grid(o, thickness)
                size[k], nodes[k], place[k] = [*grid.first, grid.spacing], grid.values.shape, sum(map(len, grids))
                self._ball[k] = [*grid.center, grid.radius]
                grids.append(grid.values.ravel())
            else:
                size[k], self._ball[k, 3] = _size(o)
        kind = np.array([ShapeKind[o.shape.upper()] for o in self.obstacles], np.int32)
        self._table = Obstacles(kind, size, np.concatenate(grids), place, nodes, np.zeros((m, 7)), np.zeros((m, 7)))

    def _poses(self) -> None:
        """Makes the poses at the start, and what they change by."""
        frames = [
            [(key.time, _pose(key)) for key in o.keyframes] if o.keyframes else [(0.0, _pose(o.pose))]
            for o in self.obstacles
        ]
        for k, keys in enumerate(frames):
            self._table.begin[k] = self._table.end[k] = keys[0][1]
        ways = ["keyframes" if o.keyframes else o.moved or "fixed" for o in self.obstacles]
        self._motion = np.array([MOTION[way] for way in ways], np.int32)
        self._first = np.concatenate([[0], np.cumsum([len(keys) for keys in frames])]).astype(np.int32)
        self._time = np.array([time for keys in frames for time, _ in keys])
        self.frames = np.array([pose for keys in frames for _, pose in keys])
        self._speed = np.array([o.max_speed or 0.0 for o in self.obstacles])
        self._turn = np.array([o.max_turn or 0.0 for o in self.obstacles])
        self._placed = np.full(len(self.obstacles), -1.0)
        self._swept = np.zeros((len(self.obstacles), 4))
        self._target: Float64 = self._table.end.copy()

    def contact_input(self) -> ContactInput:
        """Returns the rows, which the launches fill in each step, and options of the solve."""
        return self._input

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        self._system = system
        w, rows, table = self.world, self._input, self._table
        gravity = np.array(w.gravity)
        w.backend.keep(gravity, exact=True)
        detect = w.backend.module(TEXT).bind(
            "detect", len(self.node), obstacles=len(self.obstacles), **vars(table), swept=self._swept,
            pair_friction=self._pair_friction, node=self.node, body=self.body, x=w.x, predictor=w.predictor,
            free=w.free, mass=w.mass, block=system.block, gravity=gravity, force_coefficient=w.force_coefficient,
            dx_dv=w.dx_dv, kappa=self.params.stiffness, thickness=rows.thickness, obstacle=rows.obstacle,
            normal=rows.normal, gap=rows.gap, drift=rows.drift, entry=rows.entry, stiffness=rows.stiffness,
            friction=rows.friction, force=rows.force, traction=rows.traction, dropped=self.dropped,
        )  # fmt: skip
        return [self._place(self._target), detect]

    def connect(self, simulation: EffectUpdates) -> None:
        self._simulation = simulation
        self._warn_of_nodes_inside()

    def _warn_of_nodes_inside(self) -> None:
        """Logs which objects begin deeper in an obstacle than their thickness: they are pushed out, fast."""
        w, n = self.world, len(self.node)
        launch = w.backend.module(TEXT).bind(
            "distances", n, obstacles=len(self.obstacles), **vars(self._table), node=self.node, x=w.x,
            distance=np.zeros(n), nearest=np.zeros(n, np.int32),
        )  # fmt: skip
        launch()
        distance, nearest = launch.fetch("distance"), launch.fetch("nearest")
        inside = distance < -self._input.thickness[: 2 * n : 2]
        for body in w.bodies:
            if (found := np.flatnonzero(inside & (self.body == body.index))).size:
                worst = found[distance[found].argmin()]
                log.warning(
                    "object %r begins inside obstacle %r: node %d is %.3g m deep (%d such nodes); it is thrown out",
                    body.name, self.obstacles[nearest[worst]].name, self.node[worst] - body.first, -distance[worst],
                    found.size,
                )  # fmt: skip

    @property
    def targets(self) -> dict[str, Float64]:
        """Poses that clients want, as the loop was given them last, by the names of the obstacles that they move.

        A pose is (7,): position [m], unit quaternion w, x, y, z.
        """
        return {o.name: self._target[k].copy() for k, o in enumerate(self.obstacles) if o.moved == "client"}

    def move(self, name: str, position: Point, rotation: Rotation) -> None:
        """Has an obstacle go to a pose, at most at its `max_speed` and `max_turn`.

        position: of the obstacle's frame [m]. rotation: quaternion w, x, y, z of any length but 0.
        Raises ContactError.
        """
        self._check_name(name)
        if not np.isfinite([*position, *rotation]).all():
            raise ContactError(f"obstacle {name!r}: position and rotation must be finite numbers")
        away, far, length = dist(position, self._center), REACH * self._size, hypot(*rotation)
        if not away <= far:
            raise ContactError(
                f"obstacle {name!r}: position {away:.4g} m from the middle of the scene: at most {far:.4g} m, "
                f"{REACH:g} times its size"
            )
        if not 1e-6 < length < 1e6:
            raise ContactError(f"obstacle {name!r}: rotation has length {length:.4g}: a quaternion w, x, y, z of 1")
        self.restore({name: np.array([*position, *(q / length for q in rotation)])})

    def restore(self, targets: dict[str, Float64]) -> None:
        """Has the loop work with these poses, (7,) by name, from its next step on; the others stay.

        Raises ContactError.
        """
        target = self._target.copy()
        for name, pose in targets.items():
            target[self._check_name(name)] = pose
        self._target = target
        assert self._simulation is not None
        self._simulation.update_effect(self, self._place(target))

    def _check_name(self, name: str) -> int:
        """Returns the number of an obstacle that a client may move. Raises ContactError."""
        movable = [o.name for o in self.obstacles if o.moved == "client"]
        found = next((k for k, o in enumerate(self.obstacles) if o.name == name), None)
        said = f'with moved = "client": {", ".join(movable) or "none"}'
        if found is None:
            raise ContactError(f"no obstacle {name[:80]!r}; obstacles {said}")
        if name not in movable:
            raise ContactError(f"obstacle {name!r} is not moved by clients; obstacles {said}")
        return found

    def _place(self, target: Float64) -> Launch:
        """Returns the launch that moves the obstacles."""
        assert self._system is not None
        launch: Launch = self.world.backend.module(TEXT).bind(
            "place", len(self.obstacles), clock=self._system.clock, dt=self.world.dt, motion=self._motion,
            first=self._first, time=self._time, frame=self.frames, target=target, speed=self._speed, turn=self._turn,
            ball=self._ball, placed=self._placed, begin=self._table.begin, end=self._table.end, swept=self._swept,
        )  # fmt: skip
        return launch


def _surface(world: World, body: Body) -> Int32:
    """Returns the free nodes of a body's surface, in numbers of the scene, ascending."""
    nodes = np.unique(surface_triangles(body.mesh.tets)) + body.first
    return nodes[world.free[nodes] > 0].astype(np.int32)


def _surfaces(world: World, params: Params, node: Int32, body: Int32) -> Surfaces:
    """Returns what bodies need to touch each other. node, body: surface nodes and their bodies."""
    site = np.full(world.nodes, -1, np.int32)
    site[node] = np.arange(len(node), dtype=np.int32)
    triangles = [surface_triangles(b.mesh.tets) + np.int32(b.first) for b in world.bodies]
    trees = [box_tree(world.rest[t].mean(axis=1)) for t in triangles]
    boxes, first = np.cumsum([0, *map(len, trees)]), np.cumsum([0, *map(len, triangles)])
    shifted = [np.where(t < 0, t - k, t + box) for t, box, k in zip(trees, boxes, first, strict=False)]
    return Surfaces(
        body, site, np.concatenate(triangles).astype(np.int32), boxes.astype(np.int32),
        np.concatenate(shifted).astype(np.int32), _friction_of_bodies(world, params), np.array(world.gravity),
    )  # fmt: skip


def _friction_of_bodies(world: World, params: Params) -> Float64:
    """Returns the coefficient of each body on each other, (bodies, bodies)."""
    listed = {frozenset(pair.between): pair.value for pair in params.friction or ()}
    return np.array([
        [listed.get(frozenset((a.name, b.name)), (a.friction * b.friction) ** 0.5) for b in world.bodies]
        for a in world.bodies
    ])  # fmt: skip


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


def _pose(given: Any) -> list[float]:
    """Returns position and quaternion of a pose of the scene, (7,)."""
    return [*given.translate, *quaternion(given.rotate)]


def _pair_friction(world: World, params: Params) -> Float64:
    """Returns the coefficient of each body on each obstacle, (bodies, m)."""
    listed = {frozenset(pair.between): pair.value for pair in params.friction or ()}
    return np.array([
        [listed.get(frozenset((b.name, o.name)), (b.friction * o.friction) ** 0.5) for o in world.obstacles]
        for b in world.bodies
    ])  # fmt: skip


def build(world: World, listed: list[tuple[Body, Any]]) -> Contact:
    """Raises InputError for a thickness or a surface of an obstacle that cannot be used."""
    return Contact(world, listed[0][1])
