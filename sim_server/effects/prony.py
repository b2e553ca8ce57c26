# SPDX-License-Identifier: MIT
"""Viscoelasticity by a Prony series (generalized Maxwell solid), beside an elastic law: tissue, rubber, polymers.

The law beside it is the long-term one, what is left after a long time. Each term adds a spring and a dashpot in series,
with the shear modulus g mu and the relaxation time tau; mu is the shear modulus of the law at small strains. With the
deviator e of the strain in the turning frame of the element::

    G(t) = mu (1 + sum g exp(-t / tau)),   T = sum 2 g mu q,   dq/dt = de/dt - q / tau

Only shear is viscous: a change of volume has the stiffness of the law at all times. In a step q advances by what is
exact for a strain that is linear in time ::

    q' = exp(-h / tau) q + gamma (e' - e),   gamma = (1 - exp(-h / tau)) tau / h

so it is stable at any step, and of second order; the order of the step is then that of the scheme. The tangent gets the
deviatoric stiffness of 2 mu sum g gamma, positive semi-definite: fast branches (tau below h) cost the solve nothing.

Moduli of other programs: FEBio's `viscoelastic` has the same g (its elastic part is the long-term one). Abaqus with
MODULI=LONG TERM and SOFA's tables give `young` of the law as it stands here, with MODULI=INSTANTANEOUS that at time 0:
there g_i are parts of the instantaneous modulus, and with s = 1 - sum g_i the same solid is, in shear, young s and
g_i / s here. SOFA's Maxwell models give a branch by its Young's modulus: g is that over Young's modulus of the law.

The law may be any of tetrahedra; where several stand beside it, mu is the sum of theirs. For laws without moduli of
their own at small strains (costa, springs) give `shear`. The energy of the branches is in `elastic_energy`; what their
dashpots take is in `dissipated`. Rayleigh damping of the stiffness does not act on them.

Usual ranges: two to four terms, tau 0.01 to 100 s, a decade apart; g 0.1 to 2 (liver, brain, muscle up to 10).

The strain of the element is linear, as that of corotational elements: good to about 10-20 %, also beside a
hyperelastic law. The tangent leaves out how the frame turns.

Source: Taylor, Pister, Goudreau, Thermomechanical analysis of viscoelastic solids, 1970; Simo and Hughes, Computational
Inelasticity, 1998, section 10.3; Kaliske and Rothert 1997.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, check_beside_law, params_in
from sim_server.effects._history import ParamsWithHistory, TetrahedraWithHistory
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import STIFFNESS
from sim_server.scene.parameters import Parameters, Positive, as_tuple

SCOPE = "object"


class Term(Parameters):
    """A branch of the series."""

    g: Positive = Field(description="shear modulus of the branch over that of the law [-]")
    tau: Positive = Field(description="relaxation time [s]")


class Params(ParamsWithHistory):
    terms: Annotated[tuple[Term, ...], BeforeValidator(as_tuple), Field(min_length=1, max_length=16)] = Field(
        description="branches { g, tau }"
    )
    shear: Annotated[Positive | None, STIFFNESS] = Field(
        default=None, description="modulus that g is relative to [Pa]; left out: that of the law beside"
    )


class Prony(TetrahedraWithHistory):
    """memory: reached (6, m), the deviatoric strain; overstrain (6 terms, m), q of each branch.

    weight, tau (terms, m): of the branches, those of a body with fewer have g = 0.
    """

    holds = False
    text = "effects/prony.cu"

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.terms = max(len(params.terms) for _, params in listed)
        self.remember(reached=6, overstrain=6 * self.terms)
        counts = [len(body.mesh.tets) for body in self.bodies]
        table = np.tile([[[0.0], [1.0]]], (self.terms, 1, len(listed)))
        for k, (_, params) in enumerate(listed):
            table[: len(params.terms), :, k] = [[term.g, term.tau] for term in params.terms]
        rows = np.repeat(table, counts, axis=2)[:, :, self.order]
        self.weight, self.tau = (np.ascontiguousarray(rows[:, k]) for k in (0, 1))

    def join(self, others: Sequence[Effect]) -> None:
        super().join(others)
        for body in self.bodies:
            if not self.laws[body.index] and body.effects["prony"].shear is None:
                raise InputError(
                    f"object {body.name!r}, effect prony: nothing beside it has a shear modulus that g is relative to; "
                    "list a law with moduli, as corotational or neo_hookean, or give shear [Pa]"
                )
        check_beside_law(self, self.bodies, others)

    def shear_in(self, scene: Scene) -> Float64:
        given = [params.shear for params in params_in(scene, "prony", self.bodies)]
        own = np.repeat([np.nan if g is None else g for g in given], [len(b.mesh.tets) for b in self.bodies])[
            self.order
        ]
        return np.where(np.isnan(own), super().shear_in(scene), own)

    def _factors(self, time: float) -> tuple[Float64, Float64]:
        """What is left of q after a time [s], and gamma of a strain that grows over it, (terms, m) each."""
        return np.exp(-time / self.tau), -np.expm1(-time / self.tau) * self.tau / time

    def history(self) -> list[Launch]:
        decay, gain = self._factors(self.world.dt)
        return self.advance(terms=self.terms, decay=decay, gain=gain)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        decay, gain = self._factors(self.world.balance_point * self.world.dt)
        kept, share = self.weight * decay, (self.weight * gain).sum(axis=0)
        elements = self.bind_elements(terms=self.terms, kept=kept, share=share)
        return [elements, *self.gathers(system, stencil, accumulate)]

    def energies(self) -> ElementEnergies:
        """V mu sum of g |q|^2 at the end of a step [J]."""
        decay, gain = self._factors(self.world.dt)
        return self.bind_energy(terms=self.terms, weight=self.weight, decay=decay, gain=gain)


def build(world: World, listed: list[tuple[Body, Any]]) -> Effect:
    """The branches."""
    return Prony(world, listed)
