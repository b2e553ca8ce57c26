# SPDX-License-Identifier: MIT
"""Cables through an object: tendons that pull it together or bend it, as in fingers, soft arms and marionettes.

A cable runs straight from node to node, through the nodes nearest to the points of its `path`, without friction, so its
tension T [N] is the same everywhere. With its length L = sum |x_k+1 - x_k| and g_a = dL/dx_a ::

    f_a = -T g_a

at an end T along the cable, at a bend the sum of two such. Forces have neither sum nor torque. Either is given, live:

    tension       T; the energy balance counts its work
    shortening    [m] by which the cable is drawn in, with its `stiffness` k [N/m]: T = k max(0, L - L0 + shortening),
                  L0 its length at the start. A slack cable does not push. Its energy k (L - L0 + shortening)^2 / 2
                  counts as elastic, and what a change of `shortening` adds to it as work

The stiffness matrix is positive semi-definite and complete: T / l (I - e e^T) of each segment with direction e and
length l, and k g g^T, which couples every two nodes of a cable with a stiffness. So a path has at most 64 points. A
kink of T where a cable becomes slack is left to the steps.

Usual ranges: tendons of fingers 1 to 100 N, of soft arms 0.5 to 20 N; k 1e3 to 1e6 N/m (1 m of
steel wire of 1 mm: 1.5e5).

Sources: Camarillo et al., Mechanics modeling of tendon-driven continuum manipulators, IEEE Transactions on Robotics 24,
2008; Servin, Lacoursiere, Nordfelth and Bodin, Hybrid, multiresolution wires with massless frictional contacts, IEEE
Transactions on Visualization and Computer Graphics 17, 2011 (massless wires through points).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.backends.measured import Measured, columns
from sim_server.effects._base import params_in
from sim_server.effects._loads import LoadingEffect
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import (
    NotNegative,
    Parameters,
    Positive,
    Vector,
    as_tuple,
    complaint,
    nothing_beside_tables,
)

SCOPE = "object"
TEXT = "effects/cable.cu"
MOST = 64  # points of a path


def _points(path: tuple[Any, ...]) -> tuple[Any, ...]:
    if not 2 <= len(path) <= MOST:
        raise complaint(f"has {len(path)} points: must have 2 to {MOST}")
    return path


Path = Annotated[tuple[Vector, ...], BeforeValidator(as_tuple), AfterValidator(_points)]
ABOUT = {
    "path": "points in rest coordinates [m], each stands for the nearest node",
    "tension": "of the cable [N]",
    "stiffness": "of a cable that is drawn in [N/m]",
    "shortening": "by which it is drawn in [m]",
}


def _one_way(cable: Any) -> None:
    if (cable.tension is None) == (cable.stiffness is None):
        raise complaint("needs either tension [N], or stiffness [N/m] of a cable that shortening [m] draws in")
    if cable.shortening is not None and cable.stiffness is None:
        raise complaint("shortening needs the stiffness [N/m] of the cable")


class Tendon(Parameters):
    """One cable."""

    path: Path = Field(description=ABOUT["path"])
    tension: NotNegative | None = Field(default=None, description=ABOUT["tension"])
    stiffness: Positive | None = Field(default=None, description=ABOUT["stiffness"])
    shortening: float | None = Field(default=None, description=ABOUT["shortening"])

    @model_validator(mode="after")
    def _given(self) -> "Tendon":
        _one_way(self)
        return self


class Params(Parameters):
    path: Path | None = Field(default=None, description=ABOUT["path"])
    tension: Annotated[NotNegative | None, Live(0, 4, relative=True)] = Field(
        default=None, description=ABOUT["tension"]
    )
    stiffness: Positive | None = Field(default=None, description=ABOUT["stiffness"])
    shortening: Annotated[float | None, Live()] = Field(default=None, description=ABOUT["shortening"])
    tables: Annotated[Annotated[tuple[Tendon, ...], BeforeValidator(as_tuple)] | None, Live()] = Field(
        default=None, description="several cables, each { path, tension, ... }"
    )

    @model_validator(mode="after")
    def _one_form(self) -> "Params":
        if (self.path is None) == (not self.tables):
            raise complaint("needs path = ..., or a list of tables with path = ... each")
        nothing_beside_tables(self)
        if self.tables is None:
            _one_way(self)
        return self

    @property
    def tendons(self) -> Sequence["Tendon | Params"]:
        """The cables, each with `path`."""
        return self.tables or (self,)


@dataclass(frozen=True)
class Reading:
    """State of a cable in the last step: its tension [N] and length [m]."""

    object: str
    tension: float
    length: float


def nodes_of(body: Body, tendon: Tendon | Params) -> Int32:
    """Returns the nodes of the scene nearest to the points of a path. Raises InputError where two are the same."""
    assert tendon.path is not None
    points = np.array(tendon.path)
    nearest = np.array([np.argmin(((body.mesh.rest - point) ** 2).sum(axis=1)) for point in points])
    _, first, count = np.unique(nearest, return_index=True, return_counts=True)
    if (count > 1).any():
        twice = nearest[first[count > 1][0]]
        a, b = (int(k) + 1 for k in np.flatnonzero(nearest == twice)[:2])
        at = ", ".join(f"{c:.6g}" for c in body.mesh.rest[twice])
        raise InputError(
            f"object {body.name!r}: cable path: points {a} and {b} have the same nearest node, at ({at}); a cable goes "
            "through a node once, so take points farther apart or a finer mesh"
        )
    return (nearest + body.first).astype(np.int32)


class Cables(LoadingEffect):
    """All cables of a scene, one after another.

    node (k,): those of the paths; elements (m, 2): every two nodes that couple; state (cables, 4): tension [N], length
    [m], stiffness [N/m] and rate of a step (kernel text)
    """

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world)
        self._bodies = [body for body, _ in listed]
        tendons = [(body, tendon) for body, params in listed for tendon in params.tendons]
        paths = [nodes_of(body, tendon) for body, tendon in tendons]
        self._owner = np.array([body.index for body, _ in tendons], np.int64)
        self.node: Int32 = np.concatenate(paths)
        self.path_start = np.concatenate([[0], np.cumsum([len(path) for path in paths])]).astype(np.int32)
        self.segment_start = (self.path_start - np.arange(len(self.path_start))).astype(np.int32)
        self.ends = np.concatenate([np.stack([path[:-1], path[1:]], axis=1) for path in paths]).astype(np.int32)
        self.cable = np.repeat(np.arange(len(paths), dtype=np.int32), [len(path) for path in paths])
        self._segments_around()
        self._pair_nodes([tendon.stiffness is not None for _, tendon in tendons])
        self._lengths = [float(np.linalg.norm(np.diff(world.x[path], axis=0), axis=1).sum()) for path in paths]
        self.law = world.follow("cable", compute=self._law)
        self.segment, self.state = np.zeros((len(self.ends), 8)), np.zeros((len(paths), 4))
        self.slope, self.row = np.zeros((len(self.node), 3)), np.zeros((len(self.node), 12))
        self.guide = np.argsort(self.node, kind="stable").astype(np.int32)
        counts = np.bincount(self.node, minlength=world.nodes)
        self.start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._energy = np.zeros(len(paths))
        world.backend.keep(*(a for a in vars(self).values() if isinstance(a, np.ndarray) and a is not self.load))

    def _segments_around(self) -> None:
        """Numbers the segments before and after each node, -1 for none."""
        number = np.arange(len(self.node), dtype=np.int32) - self.cable
        before, after = number - 1, number.copy()
        before[self.path_start[:-1]], after[self.path_start[1:] - 1] = -1, -1
        self.around = np.stack([before, after], axis=1).astype(np.int32)

    def _pair_nodes(self, stiff: Sequence[bool]) -> None:
        """Lists what couples: neighbours, and all nodes of a cable with a stiffness."""
        pairs, joined = [], []
        for k, (first, last) in enumerate(zip(self.path_start, self.path_start[1:], strict=False)):
            inside = range(int(first), int(last))
            found = list(combinations(inside, 2) if stiff[k] else pairwise(inside))
            pairs += found
            joined += [(k, a - k if b == a + 1 else -1) for a, b in found]
        self.pair_guides = np.array(pairs, np.int32)
        self.joined = np.array(joined, np.int32)
        self.elements = np.ascontiguousarray(self.node[self.pair_guides])

    def _law(self, scene: Scene) -> Float64:
        given = [tendon for params in params_in(scene, "cable", self._bodies) for tendon in params.tendons]
        rows = [
            [t.tension or 0.0, t.stiffness or 0.0, length - (t.shortening or 0.0)]
            for t, length in zip(given, self._lengths, strict=True)
        ]
        return np.array(rows)

    def unchangeable(self, scene: Scene) -> Mapping[tuple[int, str], str]:
        """Lists keep their cables: only tension and shortening of each change."""
        reason = "only tension and shortening of the cables of a list change while steps run"
        now = params_in(scene, "cable", self._bodies)
        return {
            (body.index, "tables"): reason
            for body, params in zip(self._bodies, now, strict=True)
            if _kept(params.tendons) != _kept(body.effects["cable"].tendons)
        }

    @property
    def element_nodes(self) -> list[Int32]:
        return [self.ends[:, 0], self.node[self.path_start[:-1]], self.node]

    def _pulls(self) -> list[Launch]:
        """Returns the launches up to what each node of a path gets."""
        w, text = self.world, self.world.backend.module(TEXT)
        segments = text.bind(
            "segments", len(self.ends), ends=self.ends, x=w.x, v=w.damping_velocity, segment=self.segment
        )
        tensions = text.bind(
            "tensions", len(self.state), start=self.segment_start, segment=self.segment, law=self.law, state=self.state
        )
        guides = text.bind(
            "guides", len(self.node), cable=self.cable, around=self.around, segment=self.segment, state=self.state,
            law=self.law, coefficient=w.stiffness_coefficient(self._owner), h=w.force_coefficient, slope=self.slope,
            row=self.row,
        )  # fmt: skip
        return [segments, tensions, guides]

    def _nodal(self, kernel: str, system: System, **more: Any) -> Launch:
        launch: Launch = self.world.backend.module(TEXT).bind(
            kernel, self.world.nodes, start=self.start, guide=self.guide, row=self.row, accumulate=self.adds_to_load,
            b=system.b, load=self.load, **more,
        )  # fmt: skip
        return launch

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w = self.world
        blocks = w.backend.module("effects/cable_blocks.cu").bind(
            "blocks", len(system.sums), accumulate=int(accumulate), start=stencil.pair_start, pairs=stencil.pairs,
            guide=self.pair_guides, joined=self.joined, segment=self.segment, state=self.state,
            coefficient=w.stiffness_coefficient(self._owner), slope=self.slope, sums=system.sums,
        )  # fmt: skip
        return [*self._pulls(), self._nodal("gather", system, block=system.block), blocks]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        return [*self._pulls(), self._nodal("forces", system)]

    def energies(self) -> ElementEnergies:
        """Of cables with a stiffness [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.state), start=self.segment_start, ends=self.ends, x=self.world.x, law=self.law,
            energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self._owner)

    def measured(self) -> list[Measured]:
        """Tension and length of each cable."""
        owners: list[int] = self._owner.tolist()
        listed = [self.world.bodies[owner].effects["cable"].tables is not None for owner in owners]
        return columns(self.state, owners, "cable", listed, (("tension", "N"), ("length", "m")))

    def readings(self) -> list[Reading]:
        """Tension and length of each cable in the last evaluation, in the order of the scene."""
        names = [self.world.bodies[owner].name for owner in self._owner]
        rows = self.world.backend.fetch(self.state)
        return [Reading(name, float(row[0]), float(row[1])) for name, row in zip(names, rows, strict=True)]


def _kept(tendons: Sequence[Tendon | Params]) -> list[Any]:
    """What of the cables of a list must stay."""
    return [t.model_copy(update={"tension": t.tension is None, "shortening": None}) for t in tendons]


def build(world: World, listed: list[tuple[Body, Any]]) -> Cables:
    """The cables of the listed objects; raises InputError for a path that goes through a node twice."""
    return Cables(world, listed)
