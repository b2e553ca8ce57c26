# SPDX-License-Identifier: MIT
"""Plastic flow of corotational tetrahedra, listed beside `corotational`: metals, clay, plastics that stay bent.

Von Mises' yield condition with linear isotropic and kinematic hardening, and the return of the trial stress along its
own direction, which is the end of a step of backward Euler in closed form. In the turning frame of the element, with
the deviator e of the strain and the plastic strain p, tr p = 0::

    s = 2 mu (e - p),   xi = s - 2/3 kinematic p,   |xi| <= sqrt(2/3) (yield_stress + hardening a)
    dp = |dp| xi / |xi|,   da = sqrt(2/3) |dp|

So a bar in tension flows at `yield_stress`, then its stress grows by E H / (E + H) with the strain,
H = hardening + kinematic, and with E when it is unloaded. Isotropic hardening makes the yield surface larger
(`hardening` a), kinematic hardening moves it: a bar that has been pulled to a stress s is pressed into flow at -s, or
at s - 2 yield_stress. The flow keeps the volume, to first order in the strain.

The effect is what flow takes from the elastic forces, -2 mu p, and from the elastic stiffness; the sum is the
consistent tangent (Simo and Taylor 1985), symmetric and positive definite: along the flow at least a thousandth of the
elastic stiffness stays in the matrix, so perfect plasticity (no hardening) is no mechanism for the solve. A step with
one linearization has the elastic matrix, since where it begins nothing flows: it is stable, lags behind by a step, and
takes more energy than the flow does. Take `[integrator] linearizations` of 5 or more where loads change fast, and for
quasi-static scenes. `tangent = "exact"` of the elastic elements counts how the frame turns as if the stress were
elastic.

`yield_stress` may be a list of regions { where, yield_stress, hardening, kinematic }. `elastic_energy` has what can be
had back, that of kinematic hardening too; the rest of the work of flow is in `dissipated`.

Usual ranges: steel yield_stress 2e8 to 1e9 Pa, hardening a hundredth of young or less; polyethylene 1e7 to 3e7 Pa;
modelling clay 1e4 to 1e5 Pa. A small yield_stress beside young (below 1e-3) makes thin shear bands, which follow the
mesh. Flow keeps the volume, so linear tetrahedra lock in it as they do near Poisson's ratio 0.5: coarse meshes bend too
little. Strains add up in one frame: good to about 10-20 % of strain, elastic and plastic.

Source: Simo and Hughes, Computational Inelasticity, 1998, section 3.3; Simo and Taylor, Consistent tangent operators
for rate-independent elastoplasticity, 1985.
"""

from collections.abc import Sequence
from typing import Any

from pydantic import create_model

from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect
from sim_server.effects._history import InCorotational, ParamsWithHistory, beside_corotational
from sim_server.effects._hyperelastic import Constant, Law
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene.parameters import NotNegative, Positive

SCOPE = "object"
LAW = Law(
    "plasticity",
    (
        Constant("yield_stress", Positive, "in tension, before any flow [Pa], or a list of regions"),
        Constant("hardening", NotNegative, "isotropic: yield stress over equivalent plastic strain [Pa]", 0.0),
        Constant("kinematic", NotNegative, "kinematic hardening, likewise [Pa]", 0.0),
    ),
    pack=lambda values: [values["yield_stress"], values["hardening"], values["kinematic"]],
    refuses=False,
)
Params = create_model("Params of plasticity", __base__=(LAW.parameters(), ParamsWithHistory))


class Plasticity(InCorotational):
    """memory: plastic (6, m), the plastic strain; hardened (1, m), the equivalent one. last: constants, shear."""

    text = "effects/plasticity.cu"

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.remember(plastic=6, hardened=1)
        self.constants = self.packed(LAW)

    def join(self, others: Sequence[Effect]) -> None:
        super().join(others)
        self.remember_constants(self.constants, self.shear)

    def history(self) -> list[Launch]:
        return self.advance(shear=self.shear, constants=self.constants, last=self.last)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        elements = self.bind_elements(constants=self.constants)
        return [elements, *self.gathers(system, stencil, accumulate)]

    def energies(self) -> ElementEnergies:
        """V (mu (|e - p|^2 - |e|^2) + kinematic |p|^2 / 3), what flow takes from the elastic energy [J]."""
        return self.bind_energy(constants=self.constants)


def build(world: World, listed: list[tuple[Body, Any]]) -> Plasticity:
    """The flow; raises InputError for a body without corotational elements, and for an element in no region."""
    beside_corotational("plasticity", listed)
    return Plasticity(world, listed)
