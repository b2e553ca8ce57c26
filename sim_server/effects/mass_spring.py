# SPDX-License-Identifier: MIT
"""Mass and springs: nodes joined by linear springs, along the edges of the tetrahedra or as listed.

With d = x_j - x_i, l = |d| and u = d / l, a spring of stiffness k [N/m] and rest length l0 [m] has energy and force::

    W = k (l - l0)^2 / 2,    f_i = -f_j = k (l - l0) u

and enters the matrix with  K = k [u u^T + max(0, 1 - l0 / l) (I - u u^T)]. That is the tangent -df_i/dx_i of a spring
under tension; under compression the tangent's part across the spring is negative (it buckles) and is left out, so the
matrix stays positive definite whatever the shape. Ends that meet have no direction and no force.

`young` puts a spring on each edge of the tetrahedra, with k = 1.12 E (sum V_t) / l0^2 over the elements t at the edge,
E theirs (regions as in corotational). Directions averaged, such springs are Hooke's law with Poisson's ratio 1/4 and
E within 12 %, as that average takes all nodes to move alike; the factor makes up for it. An unstructured mesh shows
Young's modulus within 1 % at ten elements over the height (4 % at five) and Poisson's ratio 0.25. A regular mesh has
preferred directions: along a bar split as "kuhn" 1.16 E and 0.03, as "mirrored" 1.49 E and 0.16. Poisson's ratio cannot
be chosen: forces along the line between two nodes make the elasticity tensor symmetric in all four indices (Cauchy's
relation, lambda = mu), hence 1/4.

`springs` lists pairs of nodes instead, or names a text file with two node numbers a line (from 0, # begins a comment);
`stiffness` and `rest_length` are one value for all or one for each, rest_length by default the distance at rest.

Springs keep no volume: strong loads turn elements over, and the mirror image of a mesh is at rest too. For ties, thin
and fibrous things and comparison; solids are better served by corotational. Usual ranges: young as in corotational;
stiffness 1 to 1e5 N/m.

Source: van Gelder, Approximate simulation of elastic membranes by triangulated spring meshes, 1998; Choi and Ko, Stable
but responsive cloth, 2002 (the tangent under compression); Love, Mathematical Theory of Elasticity, note B (Cauchy).
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, PerBody, params_in
from sim_server.errors import InputError
from sim_server.mechanics.removal import removed_from
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.surface import EDGES
from sim_server.scene import Scene
from sim_server.scene.live import STIFFNESS, Live
from sim_server.scene.parameters import File, Parameters, Positive, as_tuple, complaint
from sim_server.scene.regions import Young, region_values

SCOPE = "object"
POISSON = 0.25  # of every network of springs without preferred directions
CALIBRATION = 1.12  # of the stiffness, by stretching unstructured bars (tests/physics/test_mass_spring_young.py)

Node = Annotated[int, Field(ge=0)]
Pair = Annotated[tuple[Node, Node], BeforeValidator(as_tuple)]
Length = Annotated[float, Field(ge=0)]


def _form(value: Any) -> str:
    return "<several>" if isinstance(value, list) else "<one>"


Pairs = Annotated[Annotated[File, Tag("<one>")] | Annotated[list[Pair], Tag("<several>")], Discriminator(_form)]
Stiffness = Annotated[
    Annotated[Positive, Tag("<one>")] | Annotated[list[Positive], Tag("<several>")], Discriminator(_form)
]
RestLength = Annotated[
    Annotated[Length, Tag("<one>")] | Annotated[list[Length], Tag("<several>")], Discriminator(_form)
]


class Params(Parameters):
    young: Annotated[Young | None, STIFFNESS] = Field(
        default=None, description="Young's modulus [Pa], or a list of regions { where, young }"
    )
    springs: Pairs | None = Field(default=None, description="pairs of nodes, or a file of them, instead of the edges")
    stiffness: Annotated[Stiffness | None, STIFFNESS] = Field(
        default=None, description="of the listed springs [N/m]: one for all, or each"
    )
    rest_length: Annotated[RestLength | None, Live(0.5, 1.5, relative=True)] = Field(
        default=None, description="of the listed springs [m]; default: as at rest"
    )

    @model_validator(mode="before")
    @classmethod
    def _without_poisson(cls, table: Any) -> Any:
        regions = table.get("young") if isinstance(table, dict) else None
        regions = regions if isinstance(regions, list) else []
        if any(isinstance(t, dict) and t.get("poisson") is not None for t in [table, *regions]):
            raise complaint(
                "poisson is not accepted: springs pull along the line between two nodes, which fixes Poisson's ratio "
                "at 1/4 (Cauchy's relation, lambda = mu); corotational takes one"
            )
        return table

    @model_validator(mode="after")
    def _edges_or_list(self) -> "Params":
        if (self.young is None) == (self.springs is None):
            raise complaint("needs either young (springs on the edges of the elements) or springs with their stiffness")
        if self.springs is None and (self.stiffness is not None or self.rest_length is not None):
            raise complaint("stiffness and rest_length belong to listed springs; on edges they follow from young")
        if self.springs is not None and self.stiffness is None:
            raise complaint("listed springs need their stiffness [N/m]")
        return self


class MassSpring(Effect):
    """Springs of all bodies that list the effect, in the order of their first nodes.

    elements (m, 2): the ends; stiffness (m,) [N/m]; length (m,) [m]. Results of a step (mass_spring.cu):
    tangent (m, 4), nodal_impulse (m, 3).
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world, self.bodies = world, [body for body, _ in listed]
        self.elastic = world.at_start(self.elastic_in)
        self._from_files = any(isinstance(params.springs, str) for _, params in listed)
        pairs = {body.index: _pairs(body, params) for body, params in listed}  # files are read once
        springs = PerBody("mass_spring", self.bodies, lambda body, params: _springs(body, params, pairs[body.index]))
        parts = world.at_start(springs)
        ends = np.concatenate([part[0] for part in parts])
        order = np.argsort(ends.min(axis=1), kind="stable")  # neighbours in memory
        self.elements: Int32 = np.ascontiguousarray(ends[order])

        def now(scene: Scene, part: int) -> Float64:
            return np.asarray(np.concatenate([found[part] for found in springs(scene)])[order])

        def stiffness(scene: Scene) -> Float64:
            found = zip(self.bodies, springs(scene), strict=True)
            return np.asarray(np.concatenate([_stiffness_left(scene, b, each[1]) for b, each in found])[order])

        self.stiffness = world.follow("mass_spring", "cutting", compute=stiffness)
        self.length = world.follow("mass_spring", compute=lambda scene: now(scene, 2))
        owner = np.repeat([body.index for body, _ in listed], [len(part[0]) for part in parts])
        self.owner = owner[order]
        m = len(self.elements)
        self.tangent, self.nodal_impulse, self._energy = np.zeros((m, 4)), np.zeros((m, 3)), np.zeros(m)

    @property
    def known_to_workers(self) -> bool:
        """False if springs come from files, which workers do not read."""
        return not self._from_files

    def cuttable(self, body: Body) -> bool:
        """Returns whether the springs of a body are those of edges, which elements have a part in."""
        return body.effects["mass_spring"].springs is None

    def elastic_in(self, scene: Scene) -> Mapping[int, tuple[Float64, Float64]]:
        given = zip(self.bodies, params_in(scene, "mass_spring", self.bodies), strict=True)
        found = {body.index: _young(body, params) for body, params in given if params.young is not None}
        return {index: (young, np.full(len(young), POISSON)) for index, young in found.items()}

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w, m = self.world, len(self.elements)
        springs = w.backend.module("effects/mass_spring.cu").bind(
            "springs", m, ends=self.elements, x=w.x, v=w.damping_velocity, stiffness=self.stiffness, length=self.length,
            stiffness_coefficient=w.stiffness_coefficient(self.owner), h=w.force_coefficient, tangent=self.tangent,
            nodal_impulse=self.nodal_impulse,
        )  # fmt: skip
        gather = w.backend.module("effects/mass_spring_nodes.cu").bind(
            "gather", w.nodes, start=stencil.corner_start, corners=stencil.corners, nodal_impulse=self.nodal_impulse,
            tangent=self.tangent, b=system.b, block=system.block,
        )  # fmt: skip
        blocks = w.backend.module("effects/mass_spring_blocks.cu").bind(
            "blocks", len(system.sums), accumulate=int(accumulate), start=stencil.pair_start, pairs=stencil.pairs,
            tangent=self.tangent, sums=system.sums,
        )  # fmt: skip
        return [springs, gather, blocks]

    def energies(self) -> ElementEnergies:
        """k (l - l0)^2 / 2 [J]."""
        launch = self.world.backend.module("effects/mass_spring.cu").bind(
            "energy", len(self.elements), ends=self.elements, x=self.world.x, stiffness=self.stiffness,
            length=self.length, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def _young(body: Body, params: Params) -> Float64:
    try:
        return region_values(params.young or 0.0, POISSON, body.centroids, body.mesh.elements_of)[0]
    except InputError as error:
        raise InputError(f"object {body.name!r}, effect mass_spring: {error}") from error


def _pairs(body: Body, params: Params) -> Int64 | None:
    """Returns the pairs of nodes that the scene lists, (k, 2); None for springs on the edges."""
    if params.springs is None:
        return None
    try:
        return _pairs_of(params.springs) if isinstance(params.springs, str) else np.array(params.springs, np.int64)
    except InputError as error:
        raise InputError(f"object {body.name!r}, effect mass_spring: {error}") from error


def _stiffness_left(scene: Scene, body: Body, stiffness: Float64) -> Float64:
    """Returns the stiffness of a body's springs [N/m] without the elements that were removed."""
    removed = removed_from(scene, body)
    if not len(removed):
        return stiffness
    young = _young(body, scene.objects[body.index].effects["mass_spring"])  # type: ignore[arg-type]
    young[removed] = 0
    return edge_springs(body.mesh.rest, body.mesh.tets, young)[1]


def _springs(body: Body, params: Params, pairs: Int64 | None) -> tuple[Int32, Float64, Float64]:
    """Returns ends, stiffness and rest length of a body's springs."""
    if pairs is not None:
        try:
            return listed_springs(body, params, pairs)
        except InputError as error:
            raise InputError(f"object {body.name!r}, effect mass_spring: {error}") from error
    ends, stiffness, length = edge_springs(body.mesh.rest, body.mesh.tets, _young(body, params))
    return ends + np.int32(body.first), stiffness, length


def edge_springs(rest: Float64, tets: Int32, young: Float64) -> tuple[Int32, Float64, Float64]:
    """Springs on the edges of elements (m, 4) of young (m,): ends (k, 2), stiffness [N/m] and length [m] (k,)."""
    corners = rest[tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    pairs = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1)
    keys, edge = np.unique(pairs[:, 0].astype(np.int64) * len(rest) + pairs[:, 1], return_inverse=True)
    ends = np.stack(np.divmod(keys, len(rest)), axis=1).astype(np.int32)
    length = np.linalg.norm(rest[ends[:, 1]] - rest[ends[:, 0]], axis=1)
    share = np.bincount(edge.ravel(), weights=np.repeat(young * volume, len(EDGES)))
    return ends, CALIBRATION * share / length**2, length


def listed_springs(body: Body, params: Params, ends: Int64) -> tuple[Int32, Float64, Float64]:
    """Ends (of the scene), stiffness and length of the springs that the scene lists; raises InputError.

    ends: (k, 2) node numbers of the body
    """
    nodes = body.last - body.first
    if body.mesh.dropped:
        raise InputError(
            f"springs name nodes by number, but {body.mesh.dropped} nodes of {body.mesh.name} are no corner of a cell "
            "and were dropped, so that numbers differ from the file's: remove those nodes from the file"
        )
    if not len(ends):
        raise InputError("springs has no pair of nodes")
    if (
        wrong := np.flatnonzero((ends < 0).any(axis=1) | (ends >= nodes).any(axis=1) | (ends[:, 0] == ends[:, 1]))
    ).size:
        k = int(wrong[0])
        raise InputError(f"spring {k + 1} joins {ends[k].tolist()}: must be two different nodes from 0 to {nodes - 1}")
    ordered = np.sort(ends, axis=1)
    _, first, count = np.unique(ordered, axis=0, return_index=True, return_counts=True)
    if (count > 1).any():
        raise InputError(f"springs lists {ordered[first[count > 1][0]].tolist()} more than once; add up the stiffness")
    apart = np.linalg.norm(body.mesh.rest[ends[:, 1]] - body.mesh.rest[ends[:, 0]], axis=1)
    stiffness = _one_each("stiffness", params.stiffness, len(ends))
    length = apart if params.rest_length is None else _one_each("rest_length", params.rest_length, len(ends))
    return (ends + body.first).astype(np.int32), stiffness, length


def _one_each(name: str, given: Any, count: int) -> Float64:
    if isinstance(given, list) and len(given) != count:
        raise InputError(f"{name} has {len(given)} values for {count} springs; must be one for all, or one for each")
    return np.broadcast_to(np.asarray(given, float), (count,)).copy()


def _pairs_of(path: str) -> Int64:
    """Reads two node numbers per line, (k, 2); raises InputError that names the line."""
    pairs = []
    try:
        with open(path, encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                words = line.partition("#")[0].split()
                if words:
                    if len(words) != 2 or not all(w.isascii() and w.isdigit() and len(w) < 10 for w in words):
                        raise InputError(f"{path}, line {number}: {line.strip()[:60]!r} is not two node numbers")
                    pairs.append([int(w) for w in words])
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"springs cannot be read from {path}: {error}") from error
    return np.array(pairs, np.int64).reshape(-1, 2)


def build(world: World, listed: list[tuple[Body, Any]]) -> MassSpring:
    """The springs; raises InputError for pairs of nodes that are none, and for an element in no region of young."""
    return MassSpring(world, listed)
