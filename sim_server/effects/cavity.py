# SPDX-License-Identifier: MIT
"""Pressure in closed cavities of an object: chambers of soft grippers, ventricles, bladders, tyres, balloons.

The wall are the triangles of the surface all of whose nodes are in `where`; together they must be closed and enclose
what is not the object. `lids = true` closes openings (a tube's ends, an inlet), each by a fan of triangles about the
mean of its nodes, which has no mass and no stiffness and hands its part of the pressure to these nodes. With the volume
V of the cavity and u_a = dV/dx_a, the areas of the wall at node a as they are now ::

    f_a = p u_a

so forces follow the wall; over a closed cavity they have neither sum nor torque. p [Pa] is the pressure above that
outside. Of each cavity one of these is given, live:

    pressure    p itself; the energy balance counts its work
    amount      a gas that is sealed in: p = ambient (amount (V0 / V)^exponent - 1). amount = 1 fills the cavity at rest
                at the pressure outside; 2 is twice as much. exponent 1: isothermal, 1.4: adiabatic air
    volume      [m3] of a liquid: p = bulk (volume - V) / V0, of either sign. V differs from it by p / bulk of V0

V0 is the volume at the start. Gas and liquid have a potential energy, which counts as elastic; what a change of
`amount` or `volume` does is work. An inflow is a `volume` that a client raises.

How u changes with the positions is left out of A, as for every load that follows a surface (traction.py). How p of a
gas or a liquid changes, h c (-dp/dV) u u^T, couples all nodes of a cavity: it is no block of A, and solves apply it
beside these, exactly. Factors do not know of it, so conjugate gradients take about one more iteration for each cavity;
it is there on a CPU alone, where ros2 needs solve = "iterate". With explicit substeps it shortens the stable step.

Usual ranges: soft grippers 10 to 100 kPa, a left ventricle to 16 kPa, a bladder 1 to 6 kPa, an eye 2 kPa; bulk 1e5 to
1e9 Pa (water 2.2e9): a hundred times the pressure keeps the volume to 1 %, and more brings nothing but rounding.

Sources: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, section 8.5 (enclosed volumes);
Hassler and Schweizerhof, On the static interaction of fluid and gas loaded multi-chamber systems, Computer Methods in
Applied Mechanics and Engineering 197, 2008 (volume-dependent pressures as updates of rank one).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.backends.measured import Measured, columns
from sim_server.backends.rank_one import RankOne
from sim_server.effects._base import Effect, params_in
from sim_server.effects._loads import LoadingEffect
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.openings import openings
from sim_server.mesh.surface import surface_triangles
from sim_server.scene import Scene, where
from sim_server.scene.live import Live
from sim_server.scene.parameters import Parameters, Positive, Where, as_tuple, complaint, where_or_tables

SCOPE = "object"
MODES = ("pressure", "amount", "volume")  # CavityMode of the kernel text
CHUNK = 64  # triangles whose volumes one thread adds up
TEXT = "effects/cavity.cu"
ABOUT = {
    "where": "triangles of the surface, by their nodes: an expression in X, Y, Z, the rest coordinates [m]",
    "pressure": "above that outside [Pa]",
    "amount": "of gas, 1: what is in it at rest [-]",
    "volume": "of liquid [m3]",
    "exponent": "of the gas [-]",
    "ambient": "pressure outside, of a gas [Pa]",
    "bulk": "modulus of the liquid [Pa]",
    "lids": "closes openings",
}


def _one_mode(cavity: Any) -> None:
    given = [mode for mode in MODES if getattr(cavity, mode) is not None]
    if len(given) != 1:
        raise complaint(f"needs one of pressure, amount and volume; has {' and '.join(given) or 'none'}")
    if (given == ["volume"]) != (cavity.bulk is not None):
        raise complaint("volume needs bulk, the modulus of the liquid [Pa], and nothing else does")


class Chamber(Parameters):
    """One cavity."""

    where: Where = Field(description=ABOUT["where"])
    pressure: float | None = Field(default=None, description=ABOUT["pressure"])
    amount: Positive | None = Field(default=None, description=ABOUT["amount"])
    volume: Positive | None = Field(default=None, description=ABOUT["volume"])
    exponent: Positive = Field(default=1.0, description=ABOUT["exponent"])
    ambient: Positive = Field(default=101325.0, description=ABOUT["ambient"])
    bulk: Positive | None = Field(default=None, description=ABOUT["bulk"])
    lids: bool = Field(default=False, description=ABOUT["lids"])

    @model_validator(mode="after")
    def _mode(self) -> "Chamber":
        _one_mode(self)
        return self


class Params(Parameters):
    where: Where | None = Field(default=None, description=ABOUT["where"])
    pressure: Annotated[float | None, Live()] = Field(default=None, description=ABOUT["pressure"])
    amount: Annotated[Positive | None, Live(0, 4)] = Field(default=None, description=ABOUT["amount"])
    volume: Annotated[Positive | None, Live(0, 4, relative=True)] = Field(default=None, description=ABOUT["volume"])
    exponent: Positive = Field(default=1.0, description=ABOUT["exponent"])
    ambient: Positive = Field(default=101325.0, description=ABOUT["ambient"])
    bulk: Positive | None = Field(default=None, description=ABOUT["bulk"])
    lids: bool = Field(default=False, description=ABOUT["lids"])
    tables: Annotated[Annotated[tuple[Chamber, ...], BeforeValidator(as_tuple)] | None, Live()] = Field(
        default=None, description="several cavities, each { where, pressure, ... }"
    )

    @model_validator(mode="after")
    def _one_form(self) -> "Params":
        where_or_tables(self)
        if self.tables is None:
            _one_mode(self)
        return self

    @property
    def chambers(self) -> Sequence["Chamber | Params"]:
        """The cavities, each with `where`."""
        return self.tables or (self,)


def mode_of(chamber: Chamber | Params) -> int:
    """Returns the number of its mode among MODES."""
    return next(k for k, mode in enumerate(MODES) if getattr(chamber, mode) is not None)


@dataclass(frozen=True)
class Reading:
    """State of a cavity in the last step: pressure above that outside [Pa], volume [m3]."""

    object: str
    where: str
    pressure: float
    volume: float


class Wall:
    """The wall of one cavity, with its lids.

    corners (t, 3): node numbers of the scene, outward from the object; -1 - k: the centre of lid k of the cavity. lids:
    nodes around each opening. volume: at the start [m3]
    """

    def __init__(self, world: World, body: Body, chamber: Chamber | Params):
        assert chamber.where is not None
        self.body, self.where = body, chamber.where
        triangles = surface_triangles(body.mesh.tets)
        wall = triangles[where.nodes(chamber.where, body.mesh)[triangles].all(axis=1)]
        said = f"object {body.name!r}: cavity where = {chamber.where!r}"
        if not len(wall):
            raise InputError(f"{said} holds all nodes of 0 of {len(triangles)} triangles of the surface")
        try:
            loops = openings(wall)
        except InputError as error:
            raise InputError(f"{said}: {error}, so no lids close it; choose all of the wall") from error
        if loops and not chamber.lids:
            raise InputError(
                f"{said} is not closed: {len(wall)} triangles leave {len(loops)} openings, the first of "
                f"{len(loops[0])} edges; choose all of the wall, or close openings with lids = true"
            )
        first = np.int32(body.first)
        self.lids = [np.array(loop, np.int32) + first for loop in loops]
        fans = [
            np.stack([np.full(len(loop), -1 - k, np.int32), np.roll(loop, -1), loop], axis=1)
            for k, loop in enumerate(self.lids)
        ]
        self.corners: Int32 = np.concatenate([wall + first, *fans]).astype(np.int32)
        self.nodes: Int32 = np.unique(wall + first).astype(np.int32)
        self.volume = self._volume(world.x)
        if not self.volume > 0:
            raise InputError(
                f"{said} encloses {self.volume:.4g} m3: the triangles must enclose what is not the object; for a "
                "pressure from outside take traction"
            )

    def _volume(self, x: Float64) -> float:
        centres = [x[loop].mean(axis=0) for loop in reversed(self.lids)]  # found by -1 - k
        corners = np.concatenate([x, *(c[None] for c in centres)])[self.corners] - x[self.nodes[0]]
        return float(-np.linalg.det(corners).sum() / 6)

    def entries(self) -> tuple[Int32, Float64, Int32]:
        """Returns triangle (k,), share (k,) and node (k,) of what each node has of the triangles."""
        triangle, corner = np.nonzero(self.corners >= 0)
        found = [(triangle, np.full(len(triangle), 1 / 3), self.corners[triangle, corner])]
        for k, loop in enumerate(self.lids):
            fan = np.flatnonzero(self.corners[:, 0] == -1 - k)
            found.append((np.repeat(fan, len(loop)), np.full(len(fan) * len(loop), 1 / 3 / len(loop)),
                          np.tile(loop, len(fan))))  # fmt: skip
        triangle, share, node = (np.concatenate(part) for part in zip(*found, strict=True))
        return triangle.astype(np.int32), share, node.astype(np.int32)


class Cavities(LoadingEffect):
    """All cavities of a scene, one after another.

    state (cavities, 4): volume [m3], pressure [Pa], and what follows from how it changes (kernel text)
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world)
        self._bodies = [body for body, _ in listed]
        self.walls = [Wall(world, body, chamber) for body, params in listed for chamber in params.chambers]
        chambers = [chamber for _, params in listed for chamber in params.chambers]
        self.mode = np.array([mode_of(chamber) for chamber in chambers], np.int32)
        if self.changes_with_volume:
            self._check_device()
        self.law = world.follow("cavity", compute=self._law)
        self.state, self._energy = np.zeros((len(self.walls), 4)), np.zeros(len(self.walls))
        self.state[:, 0] = [wall.volume for wall in self.walls]
        self._places()
        arrays = [a for a in vars(self).values() if isinstance(a, np.ndarray) and a is not self.load]
        world.backend.keep(*arrays)

    @property
    def changes_with_volume(self) -> bool:
        """True if the pressure of a cavity follows its volume."""
        return bool((self.mode > 0).any())

    def _check_device(self) -> None:
        name = self._bodies[0].name
        if self.world.backend.name == "gpu":
            raise InputError(f"object {name!r}: cavity with amount or volume runs on a CPU alone: --device cpu")
        if self.world.at_start(lambda scene: scene.uses_factor_alone):
            raise InputError(
                f"object {name!r}: cavity with amount or volume needs integrator.solve = 'iterate' with ros2, since "
                "factors do not know how the pressure changes"
            )

    def _law(self, scene: Scene) -> Float64:
        given = [c for params in params_in(scene, "cavity", self._bodies) for c in params.chambers]
        rows = [
            [getattr(c, MODES[mode_of(c)]), c.exponent, c.ambient, c.bulk or 0.0, wall.volume]
            for c, wall in zip(given, self.walls, strict=True)
        ]
        return np.array(rows)

    def unchangeable(self, scene: Scene) -> Mapping[tuple[int, str], str]:
        """Lists keep their cavities: only pressure, amount and volume of each change."""
        now = {b.index: p.chambers for b, p in zip(self._bodies, params_in(scene, "cavity", self._bodies), strict=True)}
        was = {b.index: b.effects["cavity"].chambers for b in self._bodies}
        reason = "only pressure, amount and volume of the cavities of a list change while steps run"
        kept = {i: [c.model_copy(update={MODES[mode_of(c)]: 1.0}) for c in listed] for i, listed in now.items()}
        had = {i: [c.model_copy(update={MODES[mode_of(c)]: 1.0}) for c in listed] for i, listed in was.items()}
        return {(i, "tables"): reason for i in now if kept[i] != had[i]}

    def _places(self) -> None:
        """Numbers triangles, lids, nodes and their entries of all cavities one after another."""
        walls = self.walls
        lids = np.concatenate([[0], np.cumsum([len(wall.lids) for wall in walls])])
        loops = [loop for wall in walls for loop in wall.lids]
        self.lid_start = np.concatenate([[0], np.cumsum([len(loop) for loop in loops])]).astype(np.int32)
        self.lid_nodes: Int32 = np.concatenate([np.zeros(0, np.int32), *loops])
        self.centre = np.zeros((len(loops), 6))
        corners = [np.where(w.corners < 0, w.corners - k, w.corners) for w, k in zip(walls, lids, strict=False)]
        self.corner: Int32 = np.concatenate(corners).astype(np.int32)
        self.origin = np.concatenate([np.full(len(w.corners), w.nodes[0]) for w in walls]).astype(np.int32)
        self.first = np.concatenate([[0], np.cumsum([len(w.corners) for w in walls])]).astype(np.int32)
        t = len(self.corner)
        self.area, self.swept = np.zeros((t, 3)), np.zeros((t, 2))
        runs = [np.arange(a, b, CHUNK) for a, b in zip(self.first, self.first[1:], strict=False)]
        self.chunk_start = np.concatenate([*runs, [t]]).astype(np.int32)
        self.chunks_of = np.concatenate([[0], np.cumsum([len(run) for run in runs])]).astype(np.int32)
        self.sum = np.zeros((len(self.chunk_start) - 1, 2))
        self.node_start = np.concatenate([[0], np.cumsum([len(w.nodes) for w in walls])]).astype(np.int32)
        self.node: Int32 = np.concatenate([w.nodes for w in walls])
        self.slope = np.zeros((len(self.node), 3))
        self._entries()

    def _entries(self) -> None:
        triangles, shares, rows = [], [], []
        for k, wall in enumerate(self.walls):
            triangle, share, node = wall.entries()
            triangles.append(triangle + self.first[k])
            shares.append(share)
            rows.append(np.searchsorted(wall.nodes, node) + self.node_start[k])
        row = np.concatenate(rows)
        order = np.argsort(row, kind="stable")
        self.entry_start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(self.node)))]).astype(np.int32)
        self.triangle = np.concatenate(triangles)[order].astype(np.int32)
        self.share = np.concatenate(shares)[order]
        by_node = np.argsort(self.node, kind="stable")
        self.row = by_node.astype(np.int32)
        self.cavity = (np.searchsorted(self.node_start, by_node, "right") - 1).astype(np.int32)
        counts = np.bincount(self.node, minlength=self.world.nodes)
        self.start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    @property
    def element_nodes(self) -> list[Int32]:
        lids = self.lid_nodes[self.lid_start[:-1]]
        return [lids, self.origin, self.origin[self.chunk_start[:-1]], self.node, self.node[self.node_start[:-1]]]

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w, text = self.world, self.world.backend.module(TEXT)
        moving = {"x": w.x, "predictor": w.predictor, "centre": self.centre}
        lids = text.bind("lids", len(self.centre), start=self.lid_start, node=self.lid_nodes, **moving)
        walls = text.bind(
            "walls",
            len(self.corner),
            corner=self.corner,
            origin=self.origin,
            area=self.area,
            swept=self.swept,
            **moving,
        )
        chunks = text.bind("chunks", len(self.sum), start=self.chunk_start, swept=self.swept, sum=self.sum)
        slopes = text.bind(
            "slopes", len(self.node), start=self.entry_start, triangle=self.triangle, share=self.share, area=self.area,
            slope=self.slope,
        )  # fmt: skip
        pressures = text.bind(
            "pressures", len(self.state), start=self.chunks_of, sum=self.sum, mode=self.mode, law=self.law,
            h=w.force_coefficient, dx_dv=w.dx_dv, implicit=int(not w.explicit), state=self.state,
        )  # fmt: skip
        load = text.bind(
            "load", w.nodes, start=self.start, row=self.row, cavity=self.cavity, slope=self.slope, state=self.state,
            mode=self.mode, h=w.force_coefficient, accumulate=self.adds_to_load, b=system.b, load=self.load,
        )  # fmt: skip
        return [*([lids] if len(self.centre) else []), walls, chunks, slopes, pressures, load]

    def join(self, others: Sequence[Effect]) -> None:
        """Raises InputError for walls that slide, whose part of A of rank one would have to be taken to directions."""
        rollers = self.world.rollers
        if self.changes_with_volume and rollers is not None and rollers.limited[self.node].any():
            raise InputError(
                f"object {self._bodies[0].name!r}: cavity with amount or volume cannot have nodes on its wall that are "
                "fixed along some directions only"
            )

    def rank_one(self) -> RankOne | None:
        if not self.changes_with_volume or self.world.explicit:
            return None
        owner = [wall.body.index for wall in self.walls]
        first = np.searchsorted(owner, np.arange(len(self.world.bodies) + 1)).astype(np.int32)
        return RankOne(first, self.node_start, self.node, self.slope, self.state, self.world.free)

    def energies(self) -> ElementEnergies | None:
        """Of gases and liquids [J]."""
        if not self.changes_with_volume:
            return None
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.state), first=self.first, corner=self.corner, origin=self.origin, start=self.lid_start,
            node=self.lid_nodes, x=self.world.x, mode=self.mode, law=self.law, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self._owner)

    @cached_property
    def _owner(self) -> Any:
        return np.array([wall.body.index for wall in self.walls], np.int64)

    def measured(self) -> list[Measured]:
        """Volume and pressure of each cavity."""
        listed = [wall.body.effects["cavity"].tables is not None for wall in self.walls]
        owners = [wall.body.index for wall in self.walls]
        return columns(self.state, owners, "cavity", listed, (("volume", "m3"), ("pressure", "Pa")))

    def readings(self) -> list[Reading]:
        """Pressure and volume of each cavity in the last evaluation, in the order of the scene."""
        found = self.world.backend.fetch(self.state)
        return [
            Reading(wall.body.name, wall.where, float(row[1]), float(row[0]))
            for wall, row in zip(self.walls, found, strict=True)
        ]


def build(world: World, listed: list[tuple[Body, Any]]) -> Cavities:
    """The cavities of the listed objects; raises InputError for walls that are not closed."""
    return Cavities(world, listed)
