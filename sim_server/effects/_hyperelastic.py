# SPDX-License-Identifier: MIT
"""Hyperelastic tetrahedra: common part of the laws under effects/ (st_venant_kirchhoff, neo_hookean, ...).

Multiplicative Jacobian Energy Decomposition (Marchesseau, Heimann, Chatelin, Willinger, Delingette, MICCAI 2010; Prog.
Biophys. Mol. Biol. 103, 2010), with derivatives by invariants in place of its sums of products. With corners Q_i, rest
volume V, rest gradients D_i of the shape functions, F = sum_i Q_i (x) D_i and C = F^T F, a law is an energy density
W(I1, I2, J) [J/m3] and its first and second derivatives W_p, W_pq. The gradients of the invariants at the corners
are ::

    a1_i = 2 F D_i,   a2_i = 2 (I1 - F F^T) F D_i,   aJ_i = cof(F) D_i

and force and stiffness of an element are ::

    f_i = -V sum_p W_p ap_i
    K_ij = V { sum_pq W_pq ap_i aq_j^T + 2 W_1 (D_i . D_j) I - W_J [F (D_i x D_j)]x
               + 2 W_2 [(I1 D_i . D_j - g_i . g_j) I + 2 g_i g_j^T - g_j g_i^T - (D_i . D_j) F F^T] },   g_i = F D_i

Six edge blocks are computed, K_ii = -sum_j K_ij; cof(F) D_i and F (D_i x D_j) are products and differences of the
current edges. There is no inverse of C and no fourth-order tensor. D_i . D_j costs less to compute again than to load.

`[solver] projection` makes the stiffness of every element positive semi-definite, which conjugate gradients and the
factorization need: "clamp" sets negative eigenvalues of d2W/dF2 to zero (Teran, Sifakis, Irving, Fedkiw 2005),
"absolute" takes their absolute values (Chen, Liu, Jacobson, Levin, Zheng 2024), "none" leaves them, "excess" does the
first where they are small and the second where they are large (below). "auto" (default) is "excess" where a step makes
one linearization, "clamp" with Newton-Raphson, whose line search keeps it from overshooting. Where L D L^T of the
element's stiffness finds no negative pivot nothing is done; elsewhere what its negative eigenvalues lack is added, one
mode after another, from the eigensystem by principal stretches s_i, in closed form (Smith, de Goes, Kim 2019): in the
plane of i and j, with k the third axis, ::

    twist = 2 W_1 + 2 W_2 (s_k^2 + s_i s_j) + W_J s_k,   flip = 2 W_1 + 2 W_2 (s_k^2 - s_i s_j) - W_J s_k

(no difference quotients, so nothing is lost where stretches meet) and the 3x3 matrix d2W/ds_i ds_j.

"clamp" leaves some modes without stiffness: from states with many inverted elements, at Poisson's ratios of 0.45 and
above, one linearization a step overshoots without end. "absolute" holds there, and is too stiff in ordinary motion,
where moderate compression makes a twist a little negative (a swinging beam: half as much again of the error of the one
linearization). "excess" makes of an eigenvalue e < 0 what |e| exceeds m by: m is the material's own stiffness of the
mode, the mean of twist and flip, in which the terms of W_J cancel, and 0 for d2W/ds_i ds_j. So in ordinary motion it is
"clamp", and where elements are crushed or turned over nearly "absolute". Laws without these modes (costa) have
"absolute" in its place.

Laws with ln J or a power of J are not defined at J <= 0. `inversion = "refuse"` (default) lets the solve end with the
status not_finite and names the element; "regularize" goes on below J = `floor` with the parabola that each function of
J has there, so that W stays twice continuously differentiable and pushes an inverted element back.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, create_model

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, PerBody, Refusal
from sim_server.effects._rest_shape import RestShape
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import POISSON, STIFFNESS, Live
from sim_server.scene.parameters import Parameters, Positive
from sim_server.scene.regions import Poisson, Regional, by_region, constants_by_region

Values = Mapping[str, Float64]
REMOVED_FLOOR = 0.5  # of elements that were removed, so that none of them is refused
PROJECTIONS = {"none": 0, "clamp": 1, "absolute": 2, "excess": 3}  # kernels/hyperelastic.cuh


@dataclass(frozen=True)
class Constant:
    """A material constant in the scene: its type, and its unit and meaning. default: None where it is required.

    live: its slider while steps run
    """

    name: str
    kind: Any
    text: str
    default: Any = None
    unit: str = "Pa"
    live: Live = STIFFNESS


Inversion = Literal["refuse", "regularize"]
Floor = Annotated[float, Field(gt=0, lt=1)]
INVERSION: dict[str, Any] = {
    "inversion": (Inversion, Field(default="refuse", description="what becomes of elements with J <= 0")),
    "floor": (Floor, Field(default=0.2, description="J below which the law goes on as a parabola, if regularized [-]")),
}


class InPatches(Regional):
    """Constants of a law whose elements may be patches."""

    def variant_of(self, elements: str) -> str:
        return "_patches" if elements == "patch" else self.variant


@dataclass(frozen=True)
class Law:
    """A law: the name of its effect, its constants, and their form in the kernels.

    pack: values of the constants, (m,) each -> (k, m) in the order of the kernel text. elastic: the Young's modulus
    [Pa] and Poisson's ratio that it has at small strains. axes: (m, 3, 3) material axes in columns, or None. text:
    path of the kernel text. refuses: J <= 0 is not defined. regularizes: the text takes a floor of J, and where the
    law refuses the scene may ask for it. volumetric: which of the packed constants is the factor of a function of J
    alone, of which patches take their part (_hyperelastic_patches.py); None: the law has linear elements alone.
    """

    name: str
    constants: Sequence[Constant]
    pack: Callable[[Values], Sequence[Float64]]
    elastic: Callable[[Values], tuple[Float64, Float64]] | None = None
    axes: Callable[[Values], Float64] | None = None
    text: str = ""
    refuses: bool = True
    regularizes: bool = True
    volumetric: int | None = None

    @property
    def path(self) -> str:
        """Path of the kernel text, as backend.module takes it."""
        return self.text or f"kernels/hyperelastic.cu+effects/{self.name}.cuh"

    def parameters(self) -> type[Parameters]:
        """The table of the effect in a scene."""
        kinds = {c.name: c.kind for c in self.constants}
        fields: dict[str, Any] = {}
        for c in self.constants:
            first = c is self.constants[0]  # None: required, unless every region gives it
            kind = by_region(kinds) if first else c.kind | None if c.default is None else c.kind
            given = {} if first else {"default": c.default}
            fields[c.name] = (Annotated[kind, c.live], Field(description=c.text, **given))
        extra = INVERSION if self.refuses and self.regularizes else {}
        base = Regional if self.volumetric is None else InPatches
        return create_model(f"Params of {self.name}", __base__=base, **fields, **extra)


def constants_of(law: Law, body: Body, params: Any) -> Values:
    """Values of the constants in each element of a body; raises InputError."""
    given = {c.name: getattr(params, c.name) for c in law.constants}
    try:
        return constants_by_region(given, body.centroids, law.constants[0].unit, body.mesh.elements_of)
    except InputError as error:
        raise InputError(f"object {body.name!r}, effect {law.name}: {error}") from error


class Tetrahedra(Effect):
    """Elements of all bodies that list a law, in the order of their first nodes.

    elements (m, 4); owner (m,): index of the body; number (m,): in its mesh. Results of a step, stored by
    kernels/hyperelastic.cuh: corners (4, m, 9): nodal impulses and diagonal blocks; edges (6, m, 9): blocks of edges.
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world, self.bodies = world, [body for body, _ in listed]
        self._constants_of: PerBody[Values] | None = None
        tets = np.concatenate([body.tets for body, _ in listed])
        self.order = np.argsort(tets.min(axis=1), kind="stable")  # elements near in the mesh are near in memory
        self.elements: Int32 = world.elements_of(self.bodies, self.order)
        m = len(self.elements)
        counts = [len(body.mesh.tets) for body, _ in listed]
        self.owner = np.repeat([body.index for body, _ in listed], counts)[self.order]
        self.number = np.concatenate([np.arange(n) for n in counts])[self.order]
        self.rest = RestShape(world, self.bodies, np.ascontiguousarray(tets[self.order]), self.order)
        self.volume = self.rest.followed(world, lambda scene: self.rest.volume(scene) * self.rest.present(scene))
        self.gradients = self.rest.followed(world, self._gradients)
        self.corners, self.edges = np.zeros((4, m, 9)), np.zeros((6, m, 9))
        self._energy = np.zeros(m)

    def _gradients(self, scene: Scene) -> Float64:
        """Returns gradients (9, m); 0 for elements that were removed, whose deformation is so always the same."""
        return self.rest.gradients(scene).reshape(-1, 9).T * self.rest.present(scene)

    def values_in(self, scene: Scene, law: Law) -> list[Values]:
        """Returns the constants of each body's elements by the parameters of a scene. Raises InputError."""
        if self._constants_of is None:
            self._constants_of = PerBody(law.name, self.bodies, partial(constants_of, law))
        return self._constants_of(scene)

    def packed(self, law: Law) -> Float64:
        """Returns the constants (k, m) in the form of the kernel text, which follow the scene."""
        constants: Float64 = self.world.follow(law.name, compute=partial(self.packed_in, law))
        return constants

    def packed_in(self, law: Law, scene: Scene) -> Float64:
        """Returns the constants (k, m) in the form of the kernel text by the parameters of a scene."""
        packed = [np.stack(law.pack(values)) for values in self.values_in(scene, law)]
        return np.asarray(np.concatenate(packed, axis=1)[:, self.order])

    def _of_a_step(self) -> dict[str, Any]:
        """Arguments of the integrator: coefficients of force and tangent, and the field that the tangent multiplies."""
        w = self.world
        coefficient = w.stiffness_coefficient(self.owner)
        return {"h": w.force_coefficient, "stiffness_coefficient": coefficient, "v": w.damping_velocity}

    def gathers(self, system: System, stencil: Stencil, accumulate: bool) -> list[Launch]:
        """Launches that gather corners and edges into the system."""
        w, m = self.world, len(self.elements)
        gather = w.backend.module("kernels/gather_forces.cu").bind(
            "gather", w.nodes, elements=m, start=stencil.corner_start, slots=stencil.corners, rows=self.corners,
            b=system.b, block=system.block,
        )  # fmt: skip
        blocks = w.backend.module("kernels/gather_blocks.cu").bind(
            "gather", len(system.sums), elements=m, accumulate=int(accumulate), start=stencil.pair_start,
            pairs=stencil.pairs, edges=self.edges, sums=system.sums,
        )  # fmt: skip
        return [gather, blocks]


class Hyperelastic(Tetrahedra):
    """Elements of one law. constants (k, m), floor (m,): in the form of its kernel text."""

    def __init__(self, world: World, listed: list[tuple[Body, Any]], law: Law):
        super().__init__(world, listed)
        self.law = law
        self.constants = self.packed(law)
        self.elastic = world.at_start(self.elastic_in)
        if law.axes is not None:
            along = partial(self._gradients_along, law.axes)
            self.gradients = world.follow(law.name, *self.rest.of, compute=along)
        floors = [getattr(p, "floor", 0.0) if getattr(p, "inversion", "") == "regularize" else 0.0 for _, p in listed]
        floor = np.repeat(floors, [len(body.mesh.tets) for body, _ in listed])[self.order]

        def defined(scene: Scene) -> Float64:
            return np.where(self.rest.present(scene) > 0, floor, REMOVED_FLOOR)

        self.floor = self.rest.followed(world, defined)
        self.refused = np.tile([-1.0, 0.0], (len(self.elements), 1))

    def cuttable(self, body: Body) -> bool:
        """Returns whether the law is defined for elements that are inside out, as removed ones may be."""
        return self.law.regularizes or not self.law.refuses

    def splittable(self, body: Body) -> bool:
        return True

    def _gradients_along(self, axes_of: Callable[[Values], Float64], scene: Scene) -> Float64:
        """Returns gradients (9, m) by the material axes."""
        axes = np.concatenate([axes_of(values) for values in self.values_in(scene, self.law)])[self.order]
        rows = self.rest.gradients(scene) @ axes
        return np.asarray(rows.reshape(-1, 9).T)

    def elastic_in(self, scene: Scene) -> Mapping[int, tuple[Float64, Float64]]:
        if self.law.elastic is None:
            return {}
        values = self.values_in(scene, self.law)
        return {body.index: self.law.elastic(v) for body, v in zip(self.bodies, values, strict=True)}

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w = self.world
        elements = w.backend.module(self.law.path).bind(
            "elements", len(self.elements), projection=PROJECTIONS[w.projection], tets=self.elements, x=w.x,
            gradients=self.gradients, volume=self.volume, constants=self.constants,
            clock=system.clock, refused=self.refused, corners=self.corners, edges=self.edges, **self._floor(),
            **self._of_a_step(),
        )  # fmt: skip
        return [elements, *self.gathers(system, stencil, accumulate)]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        w, m = self.world, len(self.elements)
        if self.law.text or w.beta[self.owner].any():  # damping of the stiffness is a product with the tangent
            return None
        assert stencil is not None
        impulses = np.zeros((4, m, 3))
        w.backend.keep(impulses)
        forces = w.backend.module(self.law.path).bind(
            "forces", m, tets=self.elements, x=w.x, gradients=self.gradients, volume=self.volume,
            constants=self.constants, clock=system.clock, refused=self.refused, h=w.force_coefficient,
            impulses=impulses, **self._floor(),
        )  # fmt: skip
        gather = w.backend.module("kernels/gather_forces.cu").bind(
            "gather_impulses", w.nodes, elements=m, start=stencil.corner_start, slots=stencil.corners,
            impulses=impulses, b=system.b,
        )  # fmt: skip
        return [forces, gather]

    def _floor(self) -> dict[str, Any]:
        return {"floor": self.floor} if self.law.regularizes else {}

    def energies(self) -> ElementEnergies:
        """V W [J]; NaN where an element has a deformation that the law does not define."""
        launch = self.world.backend.module(self.law.path).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, constants=self.constants, energy=self._energy, **self._floor(),
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)

    def refusals(self) -> list[Refusal]:
        found = self.world.backend.fetch(self.refused) if self.law.refuses else self.refused
        here = np.flatnonzero(found[:, 0] >= 0)
        here = here[np.lexsort((self.number[here], found[here, 0]))]
        return [
            Refusal(self.law.name, int(self.owner[e]), int(self.number[e]), float(found[e, 0]), float(found[e, 1]))
            for e in here
        ]


def hyperelastic(law: Law, world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements of bodies that list a law of which patches may have a part, all of one kind. Raises InputError."""
    if listed[0][0].elements == "linear":
        return Hyperelastic(world, listed, law)
    from sim_server.effects._hyperelastic_patches import HyperelasticPatches  # linear elements need none of it

    return HyperelasticPatches(world, listed, law)


def young_and_poisson_of(poisson: Any = Poisson) -> tuple[Constant, Constant]:
    """The constants of a law that is Hooke's at small strains. poisson: type of Poisson's ratio, with its bounds."""
    return (
        Constant("young", Positive, "Young's modulus at small strains [Pa], or a list of regions"),
        Constant(
            "poisson",
            poisson,
            "Poisson's ratio at small strains [-], of every element whose region gives none",
            live=POISSON,
        ),
    )


YOUNG_AND_POISSON = young_and_poisson_of()


def lame(values: Values) -> list[Float64]:
    """Returns Lamé's lambda and mu [Pa] of `young` and `poisson`."""
    young, poisson = values["young"], values["poisson"]
    return [young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))]


def young_and_poisson(values: Values) -> tuple[Float64, Float64]:
    """Returns Young's modulus and Poisson's ratio as given in the scene."""
    return values["young"], values["poisson"]


def of_shear_and_bulk(shear: Float64, bulk: Float64) -> tuple[Float64, Float64]:
    """Returns Young's modulus [Pa] and Poisson's ratio of a material with these moduli [Pa]."""
    return 9 * bulk * shear / (3 * bulk + shear), (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))
