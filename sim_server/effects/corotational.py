# SPDX-License-Identifier: MIT
"""Corotational linear elasticity of tetrahedra: Hooke's law in a frame that turns with the element.

With the element rotation R taken from the deformation, rest corners X_e and the constant stiffness K_e::

    f_e = -R K_e (R^T x_e - X_e),   K_e = V B^T D B,   df_e/dx_e ~ -R K_e R^T

B holds the gradients of the linear shape functions, V is the rest volume, D is Hooke's matrix with
lambda = E nu / ((1 + nu) (1 - 2 nu)) and mu = E / (2 (1 + nu)). The change of R with x is left out of the tangent,
as usual; this keeps -df/dx positive semi-definite, which the conjugate gradients and the factorization need.

Rotation of an element:

* "polar" (default): the rotation nearest to the deformation gradient F = R S. No corner is preferred; the forces are
  the slope of V (mu |S - I|^2 + lambda / 2 tr(S - I)^2); where an element is inverted, its least stretch is negative.
* "qr": that of edge 01 and face 012, by Gram and Schmidt. Cheaper, and defined however the element is inverted (short
  of a lost edge or face), but at large strains the answer depends on the order of the corners, forces have a torque
  of second order in the strain and no energy: `energy` is that of the strains alone.

Both are exact for rigid motion and agree for small strains.

A crushed body may come to rest with elements inside out. W has equilibria there: stretches such as (2, 2, -1) have the
sum 3 of no strain, which is all that lambda sees, so the more so the nearer Poisson's ratio is to 1/2 (how often:
docs/bench/hard_cases.md). No rule takes them back: less lambda while an element is inverted adds energy each time that
it turns, and runs away from 0.49 on; a term of J^2 below J = 0 is stiffer than the tangent knows.

Tangent: "usual" as above. "exact" adds how R turns with x; in terms of F, with the eigenvectors u and
eigenvalues h (sums of two stretches) of tr(S) I - S, the twists t have the eigenvalues e of d2W/dF2::

    usual + sum e t t^T,   t = R [u]x / sqrt 2,   e = 2 mu + (lambda (tr S - 3) - 2 mu) 2 / h,  not below 0

so Newton's iteration converges quadratically where no e is clamped (tension); where all are (compression) it is the
usual one. For a quarter more work a step that assembles (on a CPU); it needs "polar". "auto" (default) is "exact" in
Newmark's scheme and BDF2 with one linearization, where the usual one, softer than the forces under tension, lets the
energy grow without bound (integrator.py), and with "polar" in ros2, where the usual one feeds vibrations of bodies with
Poisson's ratio from 0.49 on that turn fast; "usual" otherwise.

Large rotations are exact, strains are linear: good to about 10-20 % strain. `young` may be one value or a list of
regions; in each region `where` is asked at the centroid of the element, at rest and before the pose; the first
region that holds gives the value, and a region without `where` takes what is left.

Usual ranges: young 1e3 Pa (brain, liver) to 1e7 Pa (rubber); 2e11 Pa (steel) works with small loads. poisson 0.3 to
0.49; from 0.49 on linear tetrahedra lock (they bend too little), and at 0.5 lambda is infinite, so 0.5 is refused.
Below 0 (auxetic foams, -0.7 to 0) lambda is negative; the stiffness is positive semi-definite down to -1, which is
refused.

Source: Müller and Gross, Interactive Virtual Materials, 2004; Nesme, Payan and Faure 2005 (QR); Chao, Pinkall, Sanan
and Schröder 2010, McAdams et al. 2011 (exact tangent); Felippa 2000.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, PerBody
from sim_server.effects._rest_shape import RestShape
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.live import POISSON, STIFFNESS
from sim_server.scene.parameters import complaint
from sim_server.scene.regions import Poisson, Regional, Young, region_values

SCOPE = "object"
REMOVED = 1e-24  # of its stiffness, which a removed element keeps, since kernels divide by mu


class Params(Regional):
    young: Annotated[Young, STIFFNESS] = Field(
        description="Young's modulus [Pa], or a list of regions { where, young, poisson }"
    )
    poisson: Annotated[Poisson | None, POISSON] = Field(
        default=None, description="Poisson's ratio [-], of every element whose region gives none"
    )
    rotation: Literal["polar", "qr"] = Field(default="polar", description="of the elements")
    tangent: Literal["auto", "usual", "exact"] = Field(
        default="auto", description="whether it knows how rotations change; auto: where the integrator gains by it"
    )

    @model_validator(mode="after")
    def _exact_is_polar(self) -> "Params":
        if self.tangent == "exact" and self.rotation != "polar":
            raise complaint('tangent = "exact" needs rotation = "polar": forces by qr have no energy to differentiate')
        return self

    def under(self, integrator: IntegratorOptions) -> "Params":
        """Returns the parameters with a tangent in place of auto. Raises a complaint if the energy would grow."""
        if integrator.needs_stiff_matrix and (self.tangent == "usual" or self.rotation == "qr"):
            given, instead = ('rotation = "qr"', 'rotation = "polar"') if self.rotation == "qr" else (
                'tangent = "usual"', 'tangent = "exact" (the default here)')  # fmt: skip
            raise complaint(
                f"{given} with integrator.scheme = {integrator.scheme!r} and linearizations = 1 gains energy without "
                f"bound: under tension its matrix is softer than the forces are; write {instead}, or "
                "integrator.linearizations = 2 or more"
            )
        if self.tangent != "auto":
            return self
        exact = integrator.needs_stiff_matrix or (integrator.scheme == "ros2" and self.rotation == "polar")
        return self.model_copy(update={"tangent": "exact" if exact else "usual"})

    @property
    def variant(self) -> str:
        """Variant of the kernels: the end of their file name, after `corotational`."""
        return "_exact" if self.tangent == "exact" else "_qr" if self.rotation == "qr" else ""

    def variant_of(self, elements: str) -> str:
        return self.variant if elements == "linear" else f"{self.variant}_cells"


class Corotational(Effect):
    """Elements of all bodies that list the effect in one of its variants, in the order of their first nodes.

    elements (m, 4); gradients (9, m), lame (2, m): constants of the elements, one kind after another. Results of a
    step: quaternion (m, 4): unit quaternions of the rotations; scaled_gradients (m, 4, 4): scaled, rotated shape
    gradients and lambda / mu; nodal_impulse (m, 4, 3) [N s]; twist (m, 6), of the exact tangent.
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world = world
        self.variant = listed[0][1].variant
        self.rotated = tuple(body for body, _ in listed)
        tets = np.concatenate([body.tets for body, _ in listed])
        order = np.argsort(tets.min(axis=1), kind="stable")  # elements near in the mesh are near in memory
        self.elements: Int32 = world.elements_of(self.rotated, order)
        self._constants = PerBody("corotational", self.rotated, _constants)
        self.elastic = world.at_start(self.elastic_in)
        rest = RestShape(world, self.rotated, np.ascontiguousarray(tets[order]), order)
        self.gradients = rest.followed(world, lambda scene: rest.gradients(scene).reshape(-1, 9).T)

        def lame(scene: Scene) -> Float64:
            young, poisson = np.concatenate([*self.elastic_in(scene).values()], axis=1)[:, order]
            lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
            mu = young / (2 * (1 + poisson))
            volume, here = rest.volume(scene), rest.present(scene)
            return np.stack([lam * volume * here, mu * volume * np.where(here > 0, 1.0, REMOVED)])

        self.lame = world.follow("corotational", *rest.of, compute=lame)
        self.present = rest.followed(world, rest.present)
        owner = np.repeat([body.index for body, _ in listed], [len(body.mesh.tets) for body, _ in listed])
        self.owner = owner[order]
        m = len(self.elements)
        self.quaternion, self.scaled_gradients = np.zeros((m, 4)), np.zeros((m, 4, 4))
        self.nodal_impulse = np.zeros((m, 4, 3))
        self.near = np.zeros((m, 4))  # quaternions of `forces`, begun at those of its last state
        self.twist = np.zeros((m if self.variant == "_exact" else 0, 6))
        self._energy = np.zeros(m)

    def cuttable(self, body: Body) -> bool:
        return True

    def splittable(self, body: Body) -> bool:
        return True

    def elastic_in(self, scene: Scene) -> Mapping[int, tuple[Float64, Float64]]:
        return {body.index: found for body, found in zip(self.rotated, self._constants(scene), strict=True)}

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w, m = self.world, len(self.elements)
        exact = self.variant == "_exact" and not w.usual_tangent
        text = f"effects/corotational{'' if self.variant == '_exact' and not exact else self.variant}"
        twist = {"twist": self.twist} if exact else {}
        sums = text if exact else "effects/corotational"
        elements = w.backend.module(f"{text}.cu").bind(
            "elements", m, tets=self.elements, x=w.x, v=w.damping_velocity, gradients=self.gradients, lame=self.lame,
            stiffness_coefficient=w.stiffness_coefficient(self.owner), h=w.force_coefficient,
            quaternion=self.quaternion, scaled_gradients=self.scaled_gradients, nodal_impulse=self.nodal_impulse,
            **twist,
        )  # fmt: skip
        gather = w.backend.module(f"{sums}_nodes.cu").bind(
            "gather", w.nodes, start=stencil.corner_start, corners=stencil.corners, nodal_impulse=self.nodal_impulse,
            scaled_gradients=self.scaled_gradients, quaternion=self.quaternion, b=system.b, block=system.block,
            mean=system.mean, **twist,
        )  # fmt: skip
        blocks = w.backend.module(f"{sums}_blocks.cu").bind(
            "blocks", len(system.sums), accumulate=int(accumulate), start=stencil.pair_start, pairs=stencil.pairs,
            scaled_gradients=self.scaled_gradients, sums=system.sums, **twist,
        )  # fmt: skip
        return [elements, gather, *self._leave_out(system, stencil, self.quaternion), blocks]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        w = self.world
        if self.variant == "_qr":
            return None
        assert stencil is not None
        damped = self.variant == "_exact" and w.beta[self.owner].any()  # by the tangent: without it both have one force
        forces = w.backend.module(f"effects/corotational{'_exact' if damped else ''}.cu").bind(
            "forces", len(self.elements), tets=self.elements, x=w.x, v=w.damping_velocity, gradients=self.gradients,
            lame=self.lame, stiffness_coefficient=w.stiffness_coefficient(self.owner), h=w.force_coefficient,
            quaternion=self.near, nodal_impulse=self.nodal_impulse,
        )  # fmt: skip
        rotations = {"quaternion": self.near, "mean": system.mean} if frames else {}
        gather = w.backend.module("effects/corotational_nodes.cu").bind(
            "gather_frames" if frames else "gather_impulses", w.nodes, start=stencil.corner_start,
            corners=stencil.corners, nodal_impulse=self.nodal_impulse, b=system.b, **rotations,
        )  # fmt: skip
        return [forces, gather, *(self._leave_out(system, stencil, self.near) if frames else [])]

    def _leave_out(self, system: System, stencil: Stencil, quaternion: Float64) -> list[Launch]:
        """Launches that leave removed elements out of the frames of nodes; none where none of these may be cut."""
        w = self.world
        if w.without_elements is None or not any("cutting" in body.effects for body in self.rotated):
            return []
        leave_out: Launch = w.backend.module("effects/corotational_cut.cu").bind(
            "leave_out", w.nodes, start=stencil.corner_start, corners=stencil.corners, present=self.present,
            quaternion=quaternion, at_rest=w.without_elements, mean=system.mean,
        )  # fmt: skip
        return [leave_out]

    @property
    def rotation(self) -> Float64:
        """(m, 3, 3) rotations of the elements at the last step."""
        return rotation_matrices(self.world.backend.fetch(self.quaternion))

    def energies(self) -> ElementEnergies:
        """V (mu |S - I|^2 + lambda / 2 tr(S - I)^2) with S = R^T F [J]."""
        text = "effects/corotational_qr.cu" if self.variant == "_qr" else "effects/corotational.cu"
        launch = self.world.backend.module(text).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients, lame=self.lame,
            energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def _constants(body: Body, params: Params) -> tuple[Float64, Float64]:
    try:
        return region_values(params.young, params.poisson, body.centroids, body.mesh.elements_of)
    except InputError as error:
        raise InputError(f"object {body.name!r}, effect corotational: {error}") from error


def rotation_matrices(quaternion: NDArray[Any]) -> Float64:
    """Rotation matrices (m, 3, 3) of unit quaternions (m, 4), w first."""
    w, x, y, z = quaternion.astype(float).T
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(entries, axis=1).reshape(-1, 3, 3)


def build(world: World, listed: list[tuple[Body, Any]]) -> Effect:
    """The elements; raises InputError for an element in no region of young."""
    if listed[0][0].elements == "linear":
        return Corotational(world, listed)
    from sim_server.effects._cells import StrainCellElements  # scenes of linear elements alone need none of it

    return StrainCellElements(world, listed, _constants)
