# SPDX-License-Identifier: MIT
"""Damage of corotational tetrahedra, listed beside `corotational`: tissue that tears, concrete, glue, plaster.

A scalar d from 0 (sound) to `most` takes from the elastic stress; it never heals, nor by live parameters. With the
strain in the turning frame of the element and its largest equivalent strain k so far::

    T = (1 - d) C strain,   d = 1 - (k0 / k) exp(-(k - k0) / kf) where k > k0, at most `most`

So a bar in tension is elastic up to `strength` = young k0, then its stress falls as strength exp(-(k - k0) / kf), and
it is unloaded along the line to the origin. The equivalent strain: with measure = "tension" (default; Mazars) the root
of the sum of the squares of the principal strains above 0, so that compression does no damage but by what it stretches
sideways; with "energy" sqrt(strain : C : strain / young), the same in tension and compression.

What softens gathers in a band of one element, so kf comes from the element's size l, for a crack to take the same
energy on any mesh (the crack band)::

    fracture_energy = l strength (k0 / 2 + kf),   l = (6 sqrt(2) V)^(1/3), the edge of a regular tetrahedron

Elements with l above 2 fracture_energy young / strength^2 would have to give energy back: they are refused. The band is
as wide as the elements stand to the crack, so its energy is that of the crack times this width over l: the same on
finer meshes of the same kind, to some ten percent on others. The path of a crack follows the mesh. A crack does not
close: in compression a torn element is as weak as in tension.

The matrix has (1 - d) C, the slope to the origin: positive definite as long as d < 1. The true slope is negative where
damage grows; it is left out, which costs linearizations (Newton-Raphson converges linearly there) and nothing else.
Loads that a body cannot bear any more have no equilibrium: a quasi-static scene then ends its steps with
`max_linearizations`; give displacements by a holder, or inertia. Rayleigh damping of the stiffness is damaged as well.
`elastic_energy` has what is left, what tearing took is in `dissipated`.

`strength` may be a list of regions { where, strength, fracture_energy }: a weaker region says where a crack begins.

Usual ranges: concrete strength 2e6 to 4e6 Pa, fracture_energy 50 to 150 J/m2; soft tissue 1e5 to 1e6 Pa, 100 to 3000
J/m2. Strains are linear: good to about 10-20 %; beyond that, as in torn elements, the law is what it is.

Source: Mazars 1984; Kachanov 1958; Bazant and Oh, Crack band theory for fracture of concrete, 1983; Oliver 1989.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect
from sim_server.effects._history import InCorotational, ParamsWithHistory, beside_corotational
from sim_server.effects._hyperelastic import Constant, Law
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.parameters import Positive

SCOPE = "object"
LAW = Law(
    "damage",
    (
        Constant("strength", Positive, "stress of a bar in tension at which it begins to tear [Pa], or regions"),
        Constant("fracture_energy", Positive, "of a crack, by its area [J/m2]"),
    ),
    pack=lambda values: [values["strength"], values["fracture_energy"]],
    refuses=False,
)
LARGEST = 0.999  # damage: what is left keeps the matrix well-conditioned


class _Measured(ParamsWithHistory):
    """Bodies of different measures are built apart."""

    @property
    def variant(self) -> str:
        return "" if vars(self)["measure"] == "tension" else "_energy"


Measure = Literal["tension", "energy"]
Params = create_model(
    "Params of damage", __base__=(LAW.parameters(), _Measured),
    measure=(Measure, Field(default="tension", description="what damages")),
    most=(Annotated[float, Field(gt=0, le=LARGEST)], Field(default=0.99, description="largest damage [-]")),
)  # fmt: skip


class Damage(InCorotational):
    """memory: largest (1, m), the largest equivalent strain. lame (m,): lambda [Pa]; limits (2, m): k0, kf.

    last: limits, lame, shear. least (1, m): damage under limits of before, which stays.
    """

    text = "effects/damage.cu"

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.remember(largest=1)
        self.least = np.zeros((1, len(self.elements)))
        world.backend.keep(self.least)
        self.tension = int(listed[0][1].measure == "tension")
        counts = [len(body.mesh.tets) for body in self.bodies]
        self.most = np.repeat([params.most for _, params in listed], counts)[self.order]
        self.lame, self.limits = np.zeros(0), np.zeros((2, 0))

    def join(self, others: Sequence[Effect]) -> None:
        super().join(others)
        self.lame = self.world.follow("corotational", compute=lambda scene: self.elasticity(scene)[0])
        self.limits = self.world.follow("damage", "corotational", "growth", compute=self._limits)
        self.remember_constants(self.limits, self.lame, self.shear)

    def _limits(self, scene: Scene) -> Float64:
        lam, mu = self.elasticity(scene)
        young = mu * (3 * lam + 2 * mu) / (lam + mu)
        strength, energy = self.packed_in(LAW, scene)
        size = np.cbrt(6 * np.sqrt(2) * self.rest.volume(scene))
        softening = energy / (size * strength) - 0.5 * strength / young
        if not (softening > 0).all():
            worst = int(np.argmin(softening / strength))
            body, held = self.world.bodies[self.owner[worst]], 0.5 * strength[worst] ** 2 / young[worst]  # [J/m3]
            raise InputError(
                f"object {body.name!r}, effect damage: an element of {size[worst]:.3g} m is too large to tear: it "
                f"holds more energy than the crack takes; allowed here: elements below {energy[worst] / held:.3g} m, "
                f"or fracture_energy above {size[worst] * held:.3g} J/m2"
            )
        return np.stack([strength / young, softening])

    @property
    def _constants(self) -> dict[str, Any]:
        limits = {"limits": self.limits, "most": self.most, "least": self.least}
        return {"lame": self.lame, "tension": self.tension, **limits}

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        return super().rows_of_bodies(self.memory["largest"] if array is self.least else array)

    def history(self) -> list[Launch]:
        return self.advance(shear=self.shear, **self._constants, last=self.last)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        elements = self.bind_elements(**self._constants, **self._of_a_step())
        return [elements, *self.gathers(system, stencil, accumulate)]

    def energies(self) -> ElementEnergies:
        """-V d (mu |strain|^2 + lambda / 2 tr(strain)^2), what damage takes from the elastic energy [J]."""
        return self.bind_energy(**self._constants)

    @property
    def damage(self) -> Float64:
        """Damage of each element as the last step began, (m,), in the order of `number` and `owner`."""
        first, scale = self.limits
        largest, least = (self.world.backend.fetch(array)[0] for array in (self.memory["largest"], self.least))
        over = np.maximum(largest - first, 0)
        found = np.minimum(1 - first / (first + over) * np.exp(-over / scale), self.most)
        return np.asarray(np.maximum(found, least))


def build(world: World, listed: list[tuple[Body, Any]]) -> Damage:
    """The damage; raises InputError for a body without corotational elements, and for one that plasticity acts on."""
    beside_corotational("damage", listed)
    for body, _ in listed:
        if "plasticity" in body.effects:
            raise InputError(f"object {body.name!r}: the effects damage and plasticity are not defined together")
    return Damage(world, listed)
