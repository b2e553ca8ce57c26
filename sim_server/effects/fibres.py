# SPDX-License-Identifier: MIT
"""Fibres that reinforce another material: muscle, tendon, annulus, arterial wall. Listed beside the law of the matrix.

One or two families of directions a in the coordinates of the rest shape, before the pose. With I4 = a . F^T F a, the
square of the stretch along the fibre::

    W = sum over the families of  stiffness / (2 exponent) (exp(exponent (I4 - 1)^2) - 1)   where I4 > 1, else 0

Fibres bear tension alone; a slack one has no energy and no stiffness. W grows with the square of I4 - 1 and its first
derivative is continuous where they slacken. At small tension a family adds 4 `stiffness` to Young's modulus along it.
The stiffness matrix is positive semi-definite as it stands, so `[solver] projection` has nothing to do.

`stiffness` may be a list of regions { where, stiffness, exponent, direction }: so directions vary over a body. A
direction needs no unit length. It has no matrix of its own: list it with neo_hookean, mooney_rivlin, corotational, ...

Usual ranges: arteries stiffness 0.5 to 2.5 kPa with exponent 0.7 to 0.9 (a rabbit's carotid, two families at 29
degrees from the circumference in the media, 62 in the adventitia), stiffer ones to 1 MPa; muscle stiffness 1 to 100
kPa, exponent 0 to 10. exponent = 0: W = stiffness / 2 (I4 - 1)^2.

Source: Holzapfel, Gasser and Ogden, A new constitutive framework for arterial wall mechanics and a comparative study of
material models, Journal of Elasticity 61, 2000 (there with the isochoric part of C).
"""

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, PlainSerializer

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._hyperelastic import Constant, Law, Tetrahedra
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import NotNegative, Positive, Vector, complaint

SCOPE = "object"


def _families(value: Any) -> Any:
    """[x, y, z] or [[x, y, z], [x, y, z]] as six numbers, zeros for a family that is not there."""
    if isinstance(value, tuple) and len(value) == 6:
        return value
    listed = value if isinstance(value, (list, tuple)) and value and isinstance(value[0], (list, tuple)) else [value]
    if len(listed) > 2 or not all(isinstance(v, (list, tuple)) and len(v) == 3 for v in listed):
        raise complaint("must be a direction [x, y, z] or a list of two of them")
    if not all(any(isinstance(c, (int, float)) and c for c in v) for v in listed):
        raise complaint("a direction must not be zero")
    return (*listed[0], *(listed[1] if len(listed) == 2 else (0.0, 0.0, 0.0)))


def _as_listed(families: tuple[float, ...]) -> list[list[float]]:
    """Directions as given in a scene."""
    return [list(v) for v in (families[:3], families[3:]) if any(v)]


Families = Annotated[
    tuple[float, float, float, float, float, float],
    BeforeValidator(_families, json_schema_input_type=Vector | list[Vector]),
    PlainSerializer(_as_listed),
]
TEXT = "effects/fibres.cu"
LAW = Law(
    "fibres",
    (
        Constant("stiffness", Positive, "of a family [Pa], or a list of regions"),
        Constant("exponent", NotNegative, "how fast it stiffens [-]", 0.0, live=Live(0, 10)),
        Constant("direction", Families, "direction at rest, or two of them for two families", live=Live()),
    ),
    pack=lambda values: [values["stiffness"], values["exponent"]],
    refuses=False,
)
Params = LAW.parameters()


class Fibres(Tetrahedra):
    """constants (2, m) and directions (6, m), as the kernel text has them."""

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.constants = self.packed(LAW)
        self.directions = world.follow(LAW.name, compute=self._directions)

    def cuttable(self, body: Body) -> bool:
        return True

    def _directions(self, scene: Scene) -> Float64:
        directions = np.concatenate([v["direction"].reshape(-1, 2, 3) for v in self.values_in(scene, LAW)])[self.order]
        length = np.linalg.norm(directions, axis=2, keepdims=True)
        return np.asarray((directions / np.where(length > 0, length, 1)).reshape(-1, 6).T)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w = self.world
        elements = w.backend.module(TEXT).bind(
            "elements", len(self.elements), tets=self.elements, x=w.x, gradients=self.gradients, volume=self.volume,
            constants=self.constants, directions=self.directions, corners=self.corners, edges=self.edges,
            **self._of_a_step(),
        )  # fmt: skip
        return [elements, *self.gathers(system, stencil, accumulate)]

    def energies(self) -> ElementEnergies:
        """V W [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, constants=self.constants, directions=self.directions, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def build(world: World, listed: list[tuple[Body, Any]]) -> Fibres:
    """The fibres; raises InputError for an element in no region, or a body that lists nothing for them to reinforce."""
    for body, _ in listed:
        if set(body.effects) <= {"fibres", "fixed", "rayleigh", "touch"}:
            raise InputError(
                f"object {body.name!r}, effect fibres: they bear tension alone; list a material beside them, as "
                "neo_hookean or corotational"
            )
    return Fibres(world, listed)
