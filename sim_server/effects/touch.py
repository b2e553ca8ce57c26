# SPDX-License-Identifier: MIT
"""Remote touch: pushes and grabs that clients send while the simulation runs.

A push is a force F [N] on the nodes within a radius of a point, for a while. A grab ties such nodes to a target point
by springs of stiffness k [N/m] in total, f = k (target - x), with a bounded force: once |f| would pass the limit, it
stays at the limit (by what f will be at the end of the step). The spring enters the system matrix (h^2 k on the
diagonal), so a stiff grab is as stable as the rest; a push is a plain force.

Interactions add up, also those of different clients: two who grab one point and pull to either side hold it between
their targets, where the springs balance; nobody owns a point.

Clients are not trusted: a push beyond `max_force` is refused, a grab is bounded by it, and at most `max_interactions`
are alive at once on one object. What they may exert together, each at its largest, is bounded by `max_total_force`; one
that would go beyond is refused, and those that are there stay as they are. Points and targets farther than REACH sizes
of the object are refused, and stiffnesses that could exceed STRONGEST there: the kernel squares the force, in single
precision too. An object that does not list this effect cannot be touched at all.

Usual ranges: max_force a few times the weight of the object (a 4000 kg beam weighs 4e4 N, a liver 15 N); a stiffness
of a grab near young times the size of the grabbed patch moves that patch without tearing it from its neighbours.
"""

from collections import deque
from collections.abc import Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import dist, hypot
from typing import Any

import numpy as np
from pydantic import Field

from protocol.push_limits import ORPHANED_PUSH
from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch, PendingUpdate
from sim_server.effects._base import Effect, EffectUpdates
from sim_server.mechanics.named_points import NamedPoints, shown
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene.parameters import Parameters

SCOPE = "object"
REACH = 1e3  # sizes of the object: how far from it a point, and from its point a target, may be
STRONGEST = 1e18  # N, stiffness times the farthest target
GIVEN = 1024  # changes of which it is remembered when the loop took them up


class Params(Parameters):
    max_force: float = Field(default=1e4, gt=0, description="largest total force of one push or grab [N]")
    max_total_force: float | None = Field(
        default=None, gt=0, description="largest force of all pushes and grabs together [N]; 4 max_force if left out"
    )
    max_interactions: int = Field(default=16, ge=1, le=1024, description="pushes and grabs alive at once on the object")

    @property
    def total(self) -> float:
        """max_total_force, or its default [N]."""
        return 4 * self.max_force if self.max_total_force is None else self.max_total_force


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Interaction:
    """A push (stiffness 0) or a grab. nodes (k,): of the scene; offset (k, 3): of each from the grabbed point [m]."""

    id: int
    client: str
    object: str
    point: Point  # m
    radius: float  # m
    nodes: Int32
    offset: Float64
    duration: float  # s of simulation
    force: Point = (0.0, 0.0, 0.0)  # N
    target: Point = (0.0, 0.0, 0.0)  # m
    stiffness: float = 0.0  # N/m
    limit: float = 0.0  # N
    start: float = -1.0  # s; negative until its first step

    @property
    def largest(self) -> float:
        """Bound of its force [N]."""
        return self.limit if self.stiffness else hypot(*self.force)


class TouchError(ValueError):
    """An interaction that is refused; the text is for the client."""


class Touch(Effect):
    """All interactions of a scene. Changes go to the loop as new arguments of the launch.

    last_id: of the interactions so far
    force (n, 3) [N], spring (n,) [N/m], anchor (n, 3) [m]: what they exert on each node in a step.
    only (1,): index of the body that alone is touched while its step is made again by short ones; -1: all are
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world = world
        self.params: dict[str, Params] = {body.name: params for body, params in listed}
        self._simulation: EffectUpdates | None = None
        self._system: System | None = None
        self._applied: list[Interaction] = []
        self._begun: list[Interaction] = []  # the same, with the times at which they began as far as they are known
        self._given: deque[tuple[PendingUpdate | None, bool]] = deque(
            maxlen=GIVEN
        )  # known_to_workers after each change
        self._together = False
        self._changed: dict[int, Interaction] | None = None  # by id: what the loop is to be given after `together`
        self._same: tuple[list[int], dict[str, Any]] | None = None  # ids, and what of a launch no move changes
        self._launch: Launch | None = None  # in use, or about to be; it writes when each interaction began
        self.last_id = 0
        self._points: dict[str, NamedPoints] = {}
        self.force, self.spring, self.anchor = np.zeros_like(world.x), np.zeros(world.nodes), np.zeros_like(world.x)
        self.only: Int32 = np.full(1, -1, np.int32)
        world.backend.keep(self.force, self.spring, self.anchor, self.only)

    def cuttable(self, body: Body) -> bool:
        return True

    def splittable(self, body: Body) -> bool:
        return True

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        self._system = system
        return [self._bind([])]

    def connect(self, simulation: EffectUpdates) -> None:
        self._simulation = simulation

    def push(self, client: str, name: str, point: Point, radius: float, force: Point, duration: float) -> Interaction:
        """Adds a force [N] on the free nodes within `radius` [m] of `point` (0: the nearest one) for `duration` [s].

        Raises TouchError.
        """
        limit = self._params(name).max_force
        size = hypot(*force)
        if not size <= limit:
            raise TouchError(f"push of {size:g} N on {name!r}: at most max_force = {limit:g} N")
        if not duration > 0:
            raise TouchError(f"push with duration = {duration:g} s: must be above 0")
        nodes, offset = self._near(name, point, radius)
        return self._add(Interaction(0, client, name, point, radius, nodes, offset, duration, force=force))

    def grab(
        self, client: str, name: str, point: Point, radius: float, target: Point, stiffness: float, max_force: float,
        duration: float,
    ) -> Interaction:  # fmt: skip
        """Ties the free nodes near `point` to `target` by springs [N/m in all] of bounded force [N].

        Raises TouchError.
        """
        limit = min(max_force, self._params(name).max_force) if max_force > 0 else self._params(name).max_force
        if not stiffness > 0 or not duration > 0:
            raise TouchError(f"grab with stiffness = {stiffness:g} N/m, duration = {duration:g} s: must be above 0")
        self._check_spring(name, point, target, stiffness)
        nodes, offset = self._near(name, point, radius)
        return self._add(
            Interaction(
                0, client, name, point, radius, nodes, offset, duration, target=target, stiffness=stiffness, limit=limit
            )
        )

    def move(self, client: str, id: int, target: Point) -> Interaction:
        """Moves the target of a grab of this client. Raises TouchError."""
        alive = self._alive()
        old = self._found(alive, client, id)
        if old.stiffness == 0:
            raise TouchError(f"interaction {id} is a push; only a grab has a target")
        self._check_spring(old.object, old.point, target, old.stiffness)
        alive[id] = moved = replace(old, target=target)
        self._put(alive)
        return moved

    def release(self, client: str, id: int) -> Interaction:
        """Ends an interaction of this client. Raises TouchError."""
        alive = self._alive()
        old = self._found(alive, client, id)
        del alive[id]
        self._put(alive)
        return old

    def release_of(self, name: str = "", ids: Container[int] = range(1 << 62)) -> None:
        """Ends pushes and grabs on an object, or on all objects. ids: of those that may end"""
        alive = self._alive()
        kept = {id: a for id, a in alive.items() if (name and a.object != name) or id not in ids}
        if len(kept) < len(alive):
            self._put(kept)

    def release_all(self, client: str) -> int:
        """Ends the grabs of a client that has gone, and its pushes ORPHANED_PUSH s from now at the latest.

        Returns the number of grabs.
        """
        alive = self._alive()
        kept = {id: self._orphaned(a) if a.client == client else a for id, a in alive.items()
                if a.client != client or a.stiffness == 0}  # fmt: skip
        if any(kept.get(id) is not a for id, a in alive.items()):
            self._same = None  # it holds durations, too
            self._put(kept)
        return len(alive) - len(kept)

    def _orphaned(self, push: Interaction) -> Interaction:
        """The push with what is left of it bounded."""
        assert self._system is not None
        past = max(float(self._system.clock[0]) - push.start, 0.0) if push.start >= 0 else 0.0
        return push if push.duration <= past + ORPHANED_PUSH else replace(push, duration=past + ORPHANED_PUSH)

    def balance_arrays(self) -> dict[str, Float64]:
        return {"force": self.force, "spring": self.spring, "anchor": self.anchor}

    @property
    def known_to_workers(self) -> bool:
        """False while there are grabs: workers do not know them."""
        return not any(a.stiffness for a in self._applied)

    def known_to_workers_at(self, step: int) -> bool:
        """True if no grab was among the interactions that the loop had taken up before `step`; newer ones may wait."""
        for pending, known in reversed(tuple(self._given)):
            if pending is None or 0 <= pending.taken <= step:
                return known
        return len(self._given) < GIVEN  # else the beginning is not known any more

    @contextmanager
    def together(self) -> Iterator[None]:
        """Changes made within the block go to the loop at its end, as one: with many clients a launch for each command
        is what costs most."""
        self._together = True
        try:
            yield
        finally:
            self._together = False
            self.flush()

    def flush(self) -> None:
        """Gives the loop what has changed."""
        if self._changed is not None:
            changed, self._changed = self._changed, None
            launch, known = self._bind(list(changed.values())), self.known_to_workers
            if not known:  # it counts already: the loop may take it up before `update_effect` returns
                self._given.append((None, known))
            assert self._simulation is not None
            pending = self._simulation.update_effect(self, launch)
            if not known:
                self._given.pop()
            self._given.append((pending, known))

    @property
    def applied(self) -> list[Interaction]:
        """Interactions that the loop was given last."""
        return self._applied

    def restore(self, interactions: list[Interaction]) -> None:
        """Has the loop work with exactly these from its next step on: those of a log."""
        self._same = None
        self._put({a.id: a for a in interactions})

    def known(self) -> list[Interaction]:
        """All interactions given to the loop last, with their start times; includes those that are over."""
        if not self._applied or self._launch is None:
            return []
        begun = zip(self._begun, self._launch.fetch("start").tolist(), strict=True)
        self._begun = [a if a.start == s else replace(a, start=s) for a, s in begun]
        return self._begun

    def alive(self) -> list[Interaction]:
        """Interactions that are not over, with their start times."""
        assert self._system is not None
        if self._changed is not None:
            return list(self._changed.values())
        time = float(self._system.clock[0])
        return [a for a in self.known() if a.start < 0 or time + self.world.dt / 2 < a.start + a.duration]

    def _params(self, name: str) -> Params:
        if name not in self.params:
            names = [body.name for body in self.world.bodies]
            if name not in names:
                raise TouchError(f"no object {name!r}; objects of the scene: {', '.join(names)}")
            listed = ", ".join(sorted(self.params))
            raise TouchError(f"object {name!r} does not list the effect touch; these do: {listed}")
        return self.params[name]

    def _alive(self) -> dict[int, Interaction]:
        """Returns `alive` by id, for a change that `_put` carries out."""
        return {a.id: a for a in self.alive()} if self._changed is None else self._changed

    def _found(self, alive: dict[int, Interaction], client: str, id: int) -> Interaction:
        found = alive.get(id)
        if found is None or found.client != client:
            raise TouchError(f"client {client!r} has no interaction {id}; it may be over")
        return found

    def points(self, name: str) -> NamedPoints:
        """Named points of the object at its present state. Raises TouchError if it cannot be touched."""
        self._params(name)
        if name not in self._points:
            self._points[name] = NamedPoints(self.world, self.world.body(name))
        return self._points[name]

    def _check_spring(self, name: str, point: Point, target: Point, stiffness: float) -> None:
        """Raises TouchError if the force of a spring from point to target might not be finite."""
        points = self.points(name)
        far, away = REACH * points.size, dist(point, target)
        if not away <= far:
            raise TouchError(f"target {shown(target)} is {away:.4g} m from the grabbed point: {_allowed(name, far)}")
        if not stiffness * far <= STRONGEST:
            raise TouchError(
                f"stiffness = {stiffness:g} N/m: at most {STRONGEST / far:.4g} N/m on {name!r}, "
                f"whose targets may be {far:.4g} m away"
            )

    def _near(self, name: str, point: Point, radius: float) -> tuple[Int32, Float64]:
        points = self.points(name)
        if radius < 0:
            raise TouchError(f"radius = {radius:g} m: must not be negative (0 = the nearest node)")
        x, far = points.now(), REACH * points.size
        away = points.distance(point)
        if not away <= far:
            raise TouchError(
                f"point {shown(point)} is {away:.4g} m from {name!r}: {_allowed(name, far)}; {points.where()}"
            )
        distance = np.where(points.free, np.linalg.norm(x - point, axis=1), np.inf)
        nearest = int(distance.argmin())
        near = np.flatnonzero(distance <= radius) if radius > 0 else np.array([nearest])
        if len(near) == 0:
            raise TouchError(
                f"no free node of {name!r} within {radius:g} m of {shown(point)}; the nearest is "
                f"{distance[nearest]:.4g} m away at {shown(x[nearest])}; {points.where()}"
            )
        return (near + points.body.first).astype(np.int32), x[near] - point

    def _add(self, new: Interaction) -> Interaction:
        if not np.isfinite([*new.point, *new.force, *new.target, new.radius, new.stiffness, new.limit]).all():
            raise TouchError("point, radius, force, target, stiffness and max_force must be finite numbers")
        alive, params = self._alive(), self._params(new.object)
        others = [a for a in alive.values() if a.object == new.object]
        if len(others) >= params.max_interactions:
            raise TouchError(
                f"object {new.object!r} has {params.max_interactions} interactions already (max_interactions)"
            )
        taken = sum(a.largest for a in others)
        if taken + new.largest > params.total * (1 + 1e-9):
            raise TouchError(
                f"object {new.object!r}: {new.largest:g} N beside the {taken:g} N of {len(others)} others: "
                f"at most max_total_force = {params.total:g} N together"
            )
        self.last_id += 1
        alive[self.last_id] = new = replace(new, id=self.last_id)
        self._put(alive)
        return new

    def _put(self, interactions: dict[int, Interaction]) -> None:
        self._changed = interactions
        if not self._together:
            self.flush()

    def _bind(self, interactions: list[Interaction]) -> Launch:
        """The launch that applies these interactions, sorted by node."""
        w, system = self.world, self._system
        assert system is not None
        ids = [a.id for a in interactions]
        if self._same is None or self._same[0] != ids:
            self._same = ids, _unmoved(w, interactions)
        self._launch = w.backend.module("effects/touch.cu").bind(
            "apply", **self._same[1], start=_each(interactions, "start"), target=_each(interactions, "target"),
            pull=np.zeros((len(self._same[1]["held"]), 4)),
            clock=system.clock, x=w.x, predictor=w.predictor, free=w.free, block=system.block, dt=w.dt,
            coefficients=w.coefficients, diagonal=system.diagonal, b=system.b, force=self.force,
            spring=self.spring, anchor=self.anchor, only=self.only,
        )  # fmt: skip
        self._applied = self._begun = interactions
        return self._launch


def _allowed(name: str, far: float) -> str:
    return f"at most {far:.4g} m, {REACH:g} times the size of {name!r}"


def _each(interactions: list[Interaction], value: str) -> Float64:
    return np.array([getattr(a, value) for a in interactions], dtype=float)


def _unmoved(world: World, interactions: list[Interaction]) -> dict[str, Any]:
    """Arguments of a launch that no move changes: all but start times and targets."""
    n, count, bodies = len(interactions), [len(a.nodes) for a in interactions], {b.name: b.index for b in world.bodies}
    nodes = np.concatenate([a.nodes for a in interactions]) if n else np.zeros(0, np.int32)
    order = np.argsort(nodes, kind="stable")
    touched, first = np.unique(nodes[order], return_index=True)
    offset = np.concatenate([a.offset for a in interactions])[order] if n else np.zeros((0, 3))
    return {
        "n": len(touched), "node": touched.astype(np.int32), "first": np.append(first, len(nodes)).astype(np.int32),
        "entry": np.repeat(np.arange(n, dtype=np.int32), count)[order], "offset": np.ascontiguousarray(offset),
        "share": 1.0 / np.array(count, dtype=float), "interactions": n,
        "whose": np.array([(a.id, bodies[a.object]) for a in interactions], np.int32).reshape(n, 2),
        "held_start": np.append(0, np.cumsum(count)).astype(np.int32),
        "held": np.stack([np.argsort(order), nodes], axis=1).astype(np.int32),
        **{value: _each(interactions, value) for value in ("duration", "stiffness", "limit")},
        "push": _each(interactions, "force"),
    }  # fmt: skip


def build(world: World, listed: list[tuple[Body, Any]]) -> Touch:
    """No interactions yet."""
    return Touch(world, listed)
