# SPDX-License-Identifier: MIT
"""Rods inside an object, glued to it: needles, wires, sutures, tendons and fibres that bear bending and compression.

A rod has a round section of `radius` r and runs along `path`, points in rest coordinates. Its own points lie on the
path about as far apart as the edges of the tetrahedra there are long, and each moves with the tetrahedron that it lies
in, by its barycentric weights: the rod adds no unknowns. Where the path crosses a gap in the object, from one lip of a
wound to the other, it is straight. With points p_k, segments l_k long, and t_k = (p_k+1 - p_k) / l_k at rest::

    stretch of a segment    E A (|p_k+1 - p_k| - l)^2 / (2 l),    A = pi r^2,    l = l_k / prestretch
    bending of a point      E I (|t_k - t_k-1| - c)^2 / (2 m),    I = pi r^4 / 4,    m = (l_k-1 + l_k) / 2

c is |t_k - t_k-1| at rest, so a rod has no force as it is laid, bent or straight, unless it has a `prestretch`: above 1
it pulls its ends together, as a suture that is tied. Of a segment between fixed points m has nothing, since it does not
bend; so a clamped end is of second order, too. Each term is a spring of a weighted sum d of nodes. Forces have neither
sum nor torque. In the matrix is the stiffness of Gauss and Newton, along d, and of what tension adds across d the
positive part. So A stays positive definite, with blocks of 3x3 between the corners of the tetrahedra of three points in
a row, at most 12; Newton-Raphson needs more iterations where a rod is compressed.

There is no twist: a section turns freely about the axis. So a rod that is curved at rest keeps its curvature, while its
plane of bending is held by the object alone. Between two of its points a rod bends only as the object's mesh can: where
the object is not much softer than the rod, the two together are too stiff on a mesh that is coarse beside the lengths
over which they bend. A rod takes no room: the material of the object fills its place, too. It does not slide along the
object; a `cable` does. `density` adds its mass to the nodes.

Usual ranges: steel 2e11 Pa, nitinol 4e10 to 8e10, polypropylene and nylon sutures 1e9 to 4e9, silk 5e9 to 1e10;
radius of needles 0.2 to 1 mm, of sutures 0.05 to 0.25 mm; density of steel 7850 kg/m3.

Sources: Bergou, Wardetzky, Robinson, Audoly and Grinspun, Discrete elastic rods, 2008 (discrete curvature; twist and
its frames are left out); Bergou, Wardetzky, Harmon, Zorin and Grinspun, A quadratic bending model for inextensible
surfaces, 2006 (bending with lengths at rest).
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, params_in
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh import Mesh
from sim_server.mesh.skin import contained
from sim_server.scene import Scene
from sim_server.scene.live import STIFFNESS, Live
from sim_server.scene.parameters import Parameters, Positive, Vector, as_tuple, complaint, nothing_beside_tables

SCOPE = "object"
TEXT, SUMS = "effects/rod.cu", "effects/rod_sums.cu"
MOST = 1000  # points of a path, and of a rod
SAMPLES = 200  # of a path, at which the edges of tetrahedra are measured
STRAIGHT = 1e-9  # |t_k - t_k-1| at rest below which a rod is straight
SAME = 1e-6  # of the length of edges: points that are nearer to each other are one
NOTHING = 1e-12  # weight, over the largest one, of a corner that takes no part


def _points(path: tuple[Any, ...]) -> tuple[Any, ...]:
    if not 2 <= len(path) <= MOST:
        raise complaint(f"has {len(path)} points: must have 2 to {MOST}")
    if any(a == b for a, b in pairwise(path)):
        raise complaint("has the same point twice in a row")
    return path


Path = Annotated[tuple[Vector, ...], BeforeValidator(as_tuple), AfterValidator(_points)]
Prestretch = Annotated[float, Field(ge=0.5, le=2)]
ABOUT = {
    "path": "points in rest coordinates [m]",
    "young": "Young's modulus [Pa]",
    "radius": "of its round section [m]",
    "prestretch": "length as it is laid over its length without force [-]",
    "density": "adds its mass to the object [kg/m3]",
}


class Single(Parameters):
    """One rod."""

    path: Path = Field(description=ABOUT["path"])
    young: Positive = Field(description=ABOUT["young"])
    radius: Positive = Field(description=ABOUT["radius"])
    prestretch: Prestretch = Field(default=1.0, description=ABOUT["prestretch"])
    density: Positive | None = Field(default=None, description=ABOUT["density"])


class Params(Parameters):
    path: Path | None = Field(default=None, description=ABOUT["path"])
    young: Annotated[Positive | None, STIFFNESS] = Field(default=None, description=ABOUT["young"])
    radius: Positive | None = Field(default=None, description=ABOUT["radius"])
    prestretch: Annotated[Prestretch | None, Live(0.8, 1.5)] = Field(default=1.0, description=ABOUT["prestretch"])
    density: Positive | None = Field(default=None, description=ABOUT["density"])
    tables: Annotated[Annotated[tuple[Single, ...], BeforeValidator(as_tuple)] | None, Live()] = Field(
        default=None, description="several rods, each { path, young, radius, ... }"
    )

    @model_validator(mode="before")
    @classmethod
    def _none_beside_tables(cls, table: Any) -> Any:
        """Takes the default of prestretch away where each rod of a list has its own."""
        return {"prestretch": None} | table if isinstance(table, dict) and table.get("tables") else table

    @model_validator(mode="after")
    def _one_form(self) -> "Params":
        nothing_beside_tables(self)
        if not self.tables and None in (self.path, self.young, self.radius):
            raise complaint("needs path, young and radius, or a list of tables with these")
        return self

    @property
    def rods(self) -> Sequence["Single | Params"]:
        """The rods, each with path, young and radius."""
        return self.tables or (self,)


class Springs(NamedTuple):
    """What a rod is made of, segments and then bends: springs of d, the sum of weights times nodes of the scene.

    nodes, weights: an array for each of the m springs; over (m,): l_k of segments, m of bends [m]; length (m,): |d| at
    rest, of segments [m], of bends [-]; bends (m,): 1 for bends, else 0; mass (k,): of the rod's points, over its
    density and A [m]; points (k, 4), shares (k, 4): corners of their tetrahedra, and weights
    """

    nodes: list[Int32]
    weights: list[Float64]
    over: Float64
    length: Float64
    bends: Float64
    mass: Float64
    points: Int32
    shares: Float64


def course(mesh: Mesh, path: Sequence[Sequence[float]]) -> tuple[Float64, Int32, Float64]:
    """Returns the points of a rod (k, 3) [m], the corners (k, 4) of their tetrahedra, and their weights (k, 4).

    Raises InputError for a point of the path that lies outside the object, for a path that ends where it begins with
    nothing in between that is farther away than the tetrahedra's edges are long, and for too many points.
    """
    given = np.array(path)
    inside = contained(given, mesh)[2]
    if not inside.all():
        at = ", ".join(f"{c:.6g}" for c in given[~inside][0])
        raise InputError(f"path: point {int(np.flatnonzero(~inside)[0]) + 1}, ({at}), lies outside the object at rest")
    spacing = _edge_length(mesh, given)
    kept = _apart(given, spacing)
    apart = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    if apart.min() < SAME * spacing:
        raise InputError(
            f"path: ends where it begins, and no point in between is {spacing:.3g} m away, the length of edges of the "
            "tetrahedra there; allowed: a longer path, other ends, or a finer mesh"
        )
    pieces = np.maximum(1, np.round(apart / spacing)).astype(int)
    if pieces.sum() >= MOST:
        raise InputError(
            f"path: would have {pieces.sum() + 1} points, as far apart as edges of the tetrahedra are long there, "
            f"{spacing:.3g} m; must have 2 to {MOST}"
        )
    parts = [a + (b - a) * np.arange(n)[:, None] / n for (a, b), n in zip(pairwise(kept), pieces, strict=True)]
    points = np.concatenate([*parts, kept[-1:]])
    corners, weights, inside = contained(points, mesh)
    return points[inside], corners[inside], weights[inside]


def _edge_length(mesh: Mesh, path: Float64) -> float:
    """Returns the mean length of the edges of the tetrahedra along a path [m]."""
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    samples = np.linspace(0, at[-1], SAMPLES)
    corners, _, inside = contained(np.stack([np.interp(samples, at, c) for c in path.T], axis=1), mesh)
    x = mesh.rest[corners[inside]]
    a, b = np.triu_indices(4, 1)
    return float(np.linalg.norm(x[:, a] - x[:, b], axis=2).mean())


def _apart(path: Float64, spacing: float) -> Float64:
    """Returns the points of a path that are no nearer to each other than `spacing` [m], with both ends."""
    kept = [path[0]]
    for point in path[1:-1]:
        if min(np.linalg.norm(point - kept[-1]), np.linalg.norm(point - path[-1])) >= spacing:
            kept.append(point)
    return np.array([*kept, path[-1]])


def springs_of(world: World, body: Body, rod: Single | Params) -> Springs:
    """Returns what a rod is made of. Raises InputError."""
    assert rod.path is not None
    try:
        p, corners, weights = course(body.mesh, rod.path)
    except InputError as error:
        raise InputError(f"object {body.name!r}, effect rod: {error}") from None
    corners = corners + np.int32(body.first)
    length = np.linalg.norm(np.diff(p, axis=0), axis=1)
    last = len(p) - 1
    moves = np.where(weights > NOTHING, world.free[corners], 0).max(axis=1) > 0
    bent = np.where(moves[:-1] | moves[1:], length, 0)
    middle = (bent[:-1] + bent[1:]) / 2
    middle[middle == 0] = 1.0  # fixed on both sides
    segments = [_sum(corners, weights, {k: -1.0, k + 1: 1.0}) for k in range(last)]
    bends = [
        _sum(corners, weights, {k - 1: 1 / a, k: -1 / a - 1 / b, k + 1: 1 / b})
        for k, (a, b) in enumerate(pairwise(length), 1)
    ]
    turn = np.linalg.norm(np.diff(np.diff(p, axis=0) / length[:, None], axis=0), axis=1)
    nodes, factors = zip(*segments, *bends, strict=True)
    share = np.zeros(len(p))
    share[:-1] += length / 2
    share[1:] += length / 2
    return Springs(
        list(nodes), list(factors), np.concatenate([length, middle]),
        np.concatenate([length, np.where(turn > STRAIGHT, turn, 0)]), np.repeat([0.0, 1.0], [last, len(bends)]),
        share, corners, weights,
    )  # fmt: skip


def _sum(corners: Int32, weights: Float64, factors: Mapping[int, float]) -> tuple[Int32, Float64]:
    """Returns nodes, each once, and their weights in a sum of points of a rod, each times a factor."""
    rows = list(factors)
    nodes, place = np.unique(corners[rows], return_inverse=True)
    values = np.bincount(place.ravel(), weights=(weights[rows] * np.array(list(factors.values()))[:, None]).ravel())
    kept = np.abs(values) > NOTHING * np.abs(values).max(initial=0)
    return nodes[kept].astype(np.int32), values[kept]


class Rods(Effect):
    """All rods of a scene, one after another.

    elements (m, c): nodes of the segments and bends, filled up with the first; weights (m, c) of them. Results of a
    step (rod.cu): tangent (m, 4), nodal_impulse (m, 3)
    """

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world, self._bodies = world, [body for body, _ in listed]
        rods = [(body, rod) for body, params in listed for rod in params.rods]
        self._parts = [springs_of(world, body, rod) for body, rod in rods]
        counts = [len(part.nodes) for part in self._parts]
        self.owner = np.repeat(np.array([body.index for body, _ in rods], np.int64), counts)
        nodes = [each for part in self._parts for each in part.nodes]
        weights = [each for part in self._parts for each in part.weights]
        m, c = len(nodes), max(len(each) for each in nodes)
        self.elements: Int32 = np.array(
            [np.append(each, np.repeat(each[0], c - len(each))) for each in nodes], np.int32
        )
        self.weights = np.array([np.append(each, np.zeros(c - len(each))) for each in weights])
        self.stiffness = world.follow("rod", compute=lambda scene: self._laws(scene)[0])
        self.length = world.follow("rod", compute=lambda scene: self._laws(scene)[1])
        self.tangent, self.nodal_impulse, self._energy = np.zeros((m, 4)), np.zeros((m, 3)), np.zeros(m)
        for part, (_, rod) in zip(self._parts, rods, strict=True):
            mass = (rod.density or 0.0) * np.pi * rod.radius**2 * part.mass[:, None] * part.shares
            np.add.at(world.mass, part.points, mass)
        world.backend.keep(self.elements, self.weights)

    def _laws(self, scene: Scene) -> tuple[Float64, Float64]:
        """Returns stiffness and length without force of the springs by the parameters of a scene, (m,) each."""
        given = [rod for params in params_in(scene, "rod", self._bodies) for rod in params.rods]
        stiffness, length = [], []
        for rod, part in zip(given, self._parts, strict=True):
            area, prestretch = np.pi * rod.radius**2, rod.prestretch or 1.0
            factor = np.where(part.bends > 0, rod.radius**2 / 4, prestretch)
            stiffness.append(rod.young * area * factor / part.over)
            length.append(np.where(part.bends > 0, part.length, part.length / prestretch))
        return np.concatenate(stiffness), np.concatenate(length)

    def unchangeable(self, scene: Scene) -> Mapping[tuple[int, str], str]:
        """Lists keep their rods: only young and prestretch of each change."""
        reason = "only young and prestretch of the rods of a list change while steps run"
        now = params_in(scene, "rod", self._bodies)
        return {
            (body.index, "tables"): reason
            for body, params in zip(self._bodies, now, strict=True)
            if _kept(params.rods) != _kept(body.effects["rod"].rods)
        }

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w, (m, c) = self.world, self.elements.shape
        springs = w.backend.module(TEXT).bind(
            "springs", m, corners=c, nodes=self.elements, weights=self.weights, x=w.x, v=w.damping_velocity,
            stiffness=self.stiffness, length=self.length, stiffness_coefficient=w.stiffness_coefficient(self.owner),
            h=w.force_coefficient, tangent=self.tangent, nodal_impulse=self.nodal_impulse,
        )  # fmt: skip
        gather = w.backend.module(SUMS).bind(
            "nodes", w.nodes, corners=c, start=stencil.corner_start, slots=stencil.corners, weights=self.weights,
            nodal_impulse=self.nodal_impulse, tangent=self.tangent, b=system.b, block=system.block,
        )  # fmt: skip
        blocks = w.backend.module(SUMS).bind(
            "blocks", len(system.sums), corners=c, accumulate=int(accumulate), start=stencil.pair_start,
            pairs=stencil.pairs, weights=self.weights, tangent=self.tangent, sums=system.sums,
        )  # fmt: skip
        return [springs, gather, blocks]

    def energies(self) -> ElementEnergies:
        """Of segments and bends [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.elements), corners=self.elements.shape[1], nodes=self.elements, weights=self.weights,
            x=self.world.x, stiffness=self.stiffness, length=self.length, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def _kept(rods: Sequence[Single | Params]) -> list[Any]:
    """What of the rods of a list must stay."""
    return [(rod.path, rod.radius, rod.density) for rod in rods]


def build(world: World, listed: list[tuple[Body, Any]]) -> Rods:
    """The rods of the listed objects; raises InputError for a path that leaves its object."""
    return Rods(world, listed)
