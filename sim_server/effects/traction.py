# SPDX-License-Identifier: MIT
"""Loads on a part of an object's surface: forces, tractions, pressures and bending moments.

The part are the triangles of the surface all of whose nodes are in `where`. On it act, alone or together,

    force     its total F [N], spread evenly over the area at rest
    stress    force by area at rest [Pa]
    pressure  p [Pa] by area as it is now, against the outward normal: a positive one pushes inward
    moment    M [N m], by a pressure that is linear over the part at rest and has no resultant there

`force` and `stress` keep size and direction (dead loads). `pressure` and `moment` follow the surface: on a triangle
with the area vector A (outward normal times area, now) node a gets

    f_a = -A (p / 3 + (q_1 + q_2 + q_3 + q_a) / 12),    q_a = c . (X_a - C)

which integrates the pressure p + q with linear shape functions exactly; dead loads go to nodes by thirds of triangles.
C is the centroid of the part at rest, in the pose in which the object begins, and c follows from

    J c = M x N,    J the second moments of area about C, N the outward normal

so that the moment at the start is M exactly, and later turns with the part. Where the part is strained unevenly its
areas change, and the pressure gets a resultant, of the order of that strain; slender bodies feel it over their length.
The part has to be flat for `moment`, and M to lie in its plane: a pressure makes no torsion. The force of a pressure on
a closed surface is zero.

Vectors are those of the scene, after the pose. Forces at fixed nodes go into what holds them.

How the forces that follow change with the positions is left out of A. This takes the order of convergence from
Newton-Raphson, not its answer, and leaves a step of one linearization the order that it has for forces which depend on
time; a pressure near that at which a body buckles, or light bodies under large ones, need small steps. The energy
balance counts the work of all of it, that of loads that follow with the force of the last evaluation in the step.

Sources: Belytschko, Liu, Moran and Elkhodary, Nonlinear Finite Elements for Continua and Structures, section 4.9
(nodal forces of pressures); Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, section 8.5.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.effects._base import params_in
from sim_server.effects._loads import LoadingEffect
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.surface import surface_triangles
from sim_server.scene import Scene, where
from sim_server.scene.live import Live
from sim_server.scene.parameters import Parameters, Vector, Where, as_tuple, complaint, where_or_tables

SCOPE = "object"
FLAT = 1e-6  # sine of the angle of normals, and of a moment to the plane, that count as none
KINDS = ("force", "stress", "pressure", "moment")
ABOUT_WHERE = "triangles of the surface, by their nodes: an expression in X, Y, Z, the rest coordinates [m]"
ABOUT = {
    "force": "in all, spread over the area at rest [N]",
    "stress": "force by area at rest [Pa]",
    "pressure": "against the outward normal, by area as it is now [Pa]",
    "moment": "bending moment by a linear pressure [N m]",
}


def _some_load(load: Any) -> None:
    if all(getattr(load, kind) is None for kind in KINDS):
        raise complaint("needs one or more of force, stress, pressure and moment")


class Load(Parameters):
    """Loads on one part of the surface."""

    where: Where = Field(description=ABOUT_WHERE)
    force: Vector | None = Field(default=None, description=ABOUT["force"])
    stress: Vector | None = Field(default=None, description=ABOUT["stress"])
    pressure: float | None = Field(default=None, description=ABOUT["pressure"])
    moment: Vector | None = Field(default=None, description=ABOUT["moment"])

    @model_validator(mode="after")
    def _loads(self) -> "Load":
        _some_load(self)
        return self


class Params(Parameters):
    where: Where | None = Field(default=None, description=ABOUT_WHERE)
    force: Annotated[Vector | None, Live()] = Field(default=None, description=ABOUT["force"])
    stress: Annotated[Vector | None, Live()] = Field(default=None, description=ABOUT["stress"])
    pressure: Annotated[float | None, Live()] = Field(default=None, description=ABOUT["pressure"])
    moment: Annotated[Vector | None, Live()] = Field(default=None, description=ABOUT["moment"])
    tables: Annotated[tuple[Load, ...], BeforeValidator(as_tuple)] | None = Field(
        default=None, description="loads on several parts, each { where, force, stress, pressure, moment }"
    )

    @model_validator(mode="after")
    def _one_form(self) -> "Params":
        where_or_tables(self)
        if self.tables is None:
            _some_load(self)
        return self

    @property
    def loads(self) -> Sequence["Load | Params"]:
        """The loads, each with `where`."""
        return self.tables or (self,)


class Part:
    """A loaded part of a surface: corners (t, 3) in node numbers of the scene, area (t, 3) at the start [m2]."""

    def __init__(self, world: World, body: Body, load: Load | Params):
        assert load.where is not None
        self.name, self.where = body.name, load.where
        triangles = surface_triangles(body.mesh.tets)
        inside = where.nodes(load.where, body.mesh)[triangles].all(axis=1)
        if not inside.any():
            raise InputError(
                f"object {body.name!r}: traction where = {load.where!r} holds all nodes of 0 of {len(triangles)} "
                "triangles of the surface; it must hold those of one or more"
            )
        self.corners: Int32 = triangles[inside] + np.int32(body.first)
        self._x = world.x[self.corners]
        self.area = np.cross(self._x[:, 1] - self._x[:, 0], self._x[:, 2] - self._x[:, 0]) / 2
        self._size = np.linalg.norm(self.area, axis=1)

    def dead(self, load: Load | Params, nodes: int) -> Float64:
        """Returns the forces on the nodes that do not follow the surface, (nodes, 3) [N]."""
        stress = np.zeros(3)
        stress += 0 if load.stress is None else np.array(load.stress)
        stress += 0 if load.force is None else np.array(load.force) / self._size.sum()
        share = np.repeat(self._size / 3, 3)
        lumped = np.bincount(self.corners.ravel(), weights=share, minlength=nodes)
        return np.asarray(lumped[:, None] * stress)

    def follows(self, load: Load | Params) -> bool:
        """True for loads with a part that follows the surface."""
        return load.pressure is not None or load.moment is not None

    def shares(self, load: Load | Params) -> Float64:
        """Returns the pressure that each corner of each triangle takes, (t, 3) [Pa]. Raises InputError."""
        shares = np.full(self.corners.shape, (load.pressure or 0.0) / 3)
        if load.moment is None:
            return shares
        arm = self._x - (self._size @ self._x.mean(axis=1)) / self._size.sum()
        linear = arm @ self._slope(np.array(load.moment), arm)
        return np.asarray(shares + (linear.sum(axis=1, keepdims=True) + linear) / 12)

    def _slope(self, moment: Float64, arm: Float64) -> Float64:
        """Returns c (3,) [Pa/m] of the linear pressure. arm (t, 3, 3): corners from the centroid [m]."""
        normals = self.area / self._size[:, None]
        normal = normals[self._size.argmax()]
        said = f"object {self.name!r}: traction moment where = {self.where!r}"
        if np.linalg.norm(np.cross(normals, normal), axis=1).max() > FLAT or (normals @ normal).min() < 0:
            raise InputError(f"{said}: the triangles must lie in one plane")
        if abs(moment @ normal) > FLAT * np.linalg.norm(moment):
            raise InputError(
                f"{said}: {moment.tolist()} has a part along the normal {np.round(normal, 6).tolist()}; a pressure "
                "makes no torsion, so it must lie in the plane of the triangles"
            )
        mean = arm.mean(axis=1)
        weight = self._size[:, None, None] / 12
        second = (weight * (np.einsum("tai,taj->tij", arm, arm) + 9 * mean[:, :, None] * mean[:, None, :])).sum(axis=0)
        return np.asarray(np.linalg.pinv(second, rcond=1e-9) @ np.cross(moment, normal))


class Traction(LoadingEffect):
    """All loads on surfaces of a scene.

    surface (t, 3): corners of the triangles whose loads follow them
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world)
        self._bodies = [body for body, _ in listed]
        self._parts = [[Part(world, body, load) for load in params.loads] for body, params in listed]
        self.dead = world.follow("traction", compute=self._dead)
        corners = [p.corners for p, load in self._each(params for _, params in listed) if p.follows(load)]
        self.surface: Int32 = np.concatenate([np.zeros((0, 3), np.int32), *corners])
        slots = np.argsort(self.surface.ravel(), kind="stable")
        self._slots = slots
        self.triangle = (slots // 3).astype(np.int32)
        counts = np.bincount(self.surface.ravel(), minlength=world.nodes)
        self.start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self.share = world.follow("traction", compute=self._shares)
        self.area = np.zeros((len(self.surface), 3))
        world.backend.keep(self.surface, self.triangle, self.start, self.area)

    def _each(self, listed: Any) -> list[tuple[Part, Load | Params]]:
        """Returns each part with its load. listed: parameters of the bodies."""
        given = zip(self._parts, listed, strict=True)
        return [each for parts, params in given for each in zip(parts, params.loads, strict=True)]

    def _dead(self, scene: Scene) -> Float64:
        loads = self._each(params_in(scene, "traction", self._bodies))
        return np.asarray(sum(part.dead(load, self.world.nodes) for part, load in loads))

    def _shares(self, scene: Scene) -> Float64:
        loads = self._each(params_in(scene, "traction", self._bodies))
        shares = [part.shares(load).ravel() for part, load in loads if part.follows(load)]
        return np.concatenate([np.zeros(0), *shares])[self._slots]

    @property
    def element_nodes(self) -> list[Int32]:
        return [self.surface[:, 0]]

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w, text = self.world, self.world.backend.module("effects/traction.cu")
        load = text.bind(
            "load", w.nodes, start=self.start, triangle=self.triangle, share=self.share, area=self.area,
            dead=self.dead, h=w.force_coefficient, accumulate=self.adds_to_load, b=system.b, load=self.load,
        )  # fmt: skip
        if not len(self.surface):
            return [load]
        return [text.bind("areas", len(self.surface), corner=self.surface, x=w.x, area=self.area), load]


def build(world: World, listed: list[tuple[Body, Any]]) -> Traction:
    """Loads on the surfaces of the listed objects; raises InputError for a part without triangles."""
    return Traction(world, listed)
