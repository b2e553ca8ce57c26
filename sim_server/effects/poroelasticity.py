# SPDX-License-Identifier: MIT
"""Poroelasticity (Biot 1941): a fluid that fills the pores of a body, beside an elastic law. Cartilage, discs, brain,
liver, gels, soil.

The law beside it is that of the drained body, as it is when the fluid has had time to flow. With the pore pressure p,
J = det F, Biot's coefficient alpha and modulus M, and the mobility k of the fluid (permeability over viscosity) ::

    sum of forces on the solid: -alpha p J F^-T beside the stress of the law
    1/M dp/dt + alpha dJ/dt = div (k grad p)

p is in elements and flows by linear shape functions of its means at nodes, in the shape at rest. It is 0 where
`drained` says; everywhere else the surface is sealed.
What is loaded fast is carried by the fluid (bulk modulus K + alpha^2 M), then flows away.

A step is split where the fluid's mass is kept (undrained split): forces and positions are those of a body whose fluid
stays where it is, p = p0 - alpha M (J - J0) in an element with p0 and J0 of the end of the last step; then the fluid
flows while the solid rests. So no step is too large to be stable; one is too large to be right where the fluid would
flow through the body with the solid at rest, L^2 / (k M), and drains later then. The forces have the potential
V p^2 / (2 M), and the tangent gets alpha^2 M V grad J grad J^T, positive semi-definite; what is left out is how grad J
turns. The flow is made by the stages of a Runge-Kutta-Legendre method, as many as the largest rate of the mesh asks
for: no system is solved, and CPU and GPU do the same. Errors of split and flow are of the first order in the step.

Usual ranges: k 1e-16 to 1e-14 m2/(Pa s) cartilage and discs, 1e-13 to 1e-10 brain, liver and gels, 1e-9 sand and
sponges; alpha 1. M is that of the fluid over the porosity, 1e9 Pa and more in tissue, where both solid and fluid hardly
change their volume: ten to a hundred times the bulk modulus K of the law is as good. More makes linear elements lock
while they are undrained, as a Poisson's ratio near 0.5 does. Time to drain: L^2 / (k K).

The inertia of the fluid against the solid is left out, and so is its weight: p is that above hydrostatic pressure. `k`
is that at rest, whatever the strain. The energy of the compressed fluid counts as elastic; what the flow takes counts
as dissipated.

Sources: Biot, General theory of three-dimensional consolidation, J. Appl. Phys. 12, 1941; Kim, Tchelepi, Juanes,
Stability, accuracy and efficiency of sequential methods for coupled flow and geomechanics, SPE J. 16, 2011 (splits);
Meyer, Balsara, Aslam, A stabilized Runge-Kutta-Legendre method, J. Comput. Phys. 257, 2014 (RKL1).
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import scipy.sparse as sp
from pydantic import Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, check_beside_law
from sim_server.effects._history import ParamsWithHistory, TetrahedraWithHistory
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import where
from sim_server.scene.parameters import Positive, Where

SCOPE = "object"
ELEMENTS, FLOW = "effects/poroelasticity.cu", "effects/pore_flow.cu"
MOST_STAGES = 64
SAFETY = 0.9  # of the largest stable step of the stages
SEALED, DRAINED = 10, 3  # rates of what the means at nodes are blind to, over k M / volume^(2/3) of an element [-]


class Params(ParamsWithHistory):
    mobility: Positive = Field(description="permeability over viscosity of the fluid [m2/(Pa s)]")
    storage: Positive = Field(description="Biot's modulus M [Pa]")
    biot: Annotated[float, Field(gt=0, le=1)] = Field(default=1.0, description="Biot's coefficient [-]")
    drained: Where | None = Field(
        default=None, description="nodes where the pressure is 0: an expression in X, Y, Z [m]; none if left out"
    )


class Poroelasticity(TetrahedraWithHistory):
    """memory: jacobian (1, m), J at the end of the last step; inner (1, m), the pressure there after the flow [Pa].

    pressure (n,): at nodes of the scene, before the fluid flows [Pa]. stages: of the flow in a step.
    """

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.remember(jacobian=1, inner=1)
        self.memory["jacobian"][...] = 1
        self.biot, self.storage, self.mobility = (
            self._of_elements([getattr(params, key) for _, params in listed]) for key in ("biot", "storage", "mobility")
        )
        self.coupling, self.stiffness = self.biot * self.storage, self.biot**2 * self.storage
        self.pressure, self._mean, self._odd, self._even = (np.zeros(world.nodes) for _ in range(4))
        self._rest = np.zeros(len(self.elements))
        world.backend.keep(self.pressure, self._mean, self._odd, self._even, self._rest)
        nodes, parts, m = self.elements.ravel(), np.repeat(self.volume / 4, 4), len(self.elements)
        parts_of_nodes = sp.csr_matrix((parts, (nodes, np.repeat(np.arange(m), 4))), (world.nodes, m))
        total = np.bincount(nodes, parts, world.nodes)
        scale, self._open = np.divide(1, total, out=np.zeros(world.nodes), where=total > 0), _open_nodes(world, listed)
        self._share = sp.csr_matrix(sp.diags(scale) @ parts_of_nodes)
        self._rate = world.dt * self._open * scale * (self._share @ self.storage)
        self._flow = self._flow_of_nodes()
        self.stages = self._number(float((self._rate * abs(self._flow).sum(axis=1).A1).max()))

    def _of_elements(self, values: list[float]) -> Float64:
        return np.repeat(values, [len(body.mesh.tets) for body in self.bodies])[self.order]

    def join(self, others: Sequence[Effect]) -> None:
        """It needs no moduli of what is beside it, but a law."""
        check_beside_law(self, self.bodies, others)

    def _flow_of_nodes(self) -> sp.csr_matrix:
        """Returns the flow out of nodes by the pressures of all, (n, n) [m3/(Pa s)]."""
        n, m = self.world.nodes, len(self.elements)
        inner = self.gradients.T.reshape(m, 3, 3)  # of corners 1, 2, 3
        slopes = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
        entries = (self.mobility * self.volume)[:, None, None] * (slopes @ slopes.transpose(0, 2, 1))
        rows = np.broadcast_to(self.elements[:, :, None], (m, 4, 4)).ravel()
        columns = np.broadcast_to(self.elements[:, None], (m, 4, 4)).ravel()
        return sp.csr_matrix((entries.ravel(), (rows, columns)), (n, n))

    def history(self) -> list[Launch]:
        w, m, module = self.world, len(self.elements), self.world.backend.module(ELEMENTS)
        inner, watched = self.memory["inner"], self.watched()
        advance = module.bind(
            "advance", m, tets=self.elements, x=w.x, gradients=self.gradients, free=w.free, watched=watched,
            coupling=self.coupling, **self.memory,
        )  # fmt: skip
        rest = module.bind("rest_of", m, tets=self.elements, mean=self.pressure, inner=inner, rest=self._rest)
        spread = module.bind(
            "spread", m, tets=self.elements, pressure=self.pressure, flowed=self._even, rest=self._rest,
            mean=self._mean, between=self._between(), free=w.free, watched=watched, inner=inner,
        )  # fmt: skip
        before, after = self._means(inner, self.pressure), self._means(self._rest, self._mean)
        return [advance, before, *self._stages(), rest, after, spread]

    def _means(self, field: Float64, mean: Float64) -> Launch:
        """Returns the launch that takes the means of a field of elements at nodes, 0 where it is drained."""
        s = self._share
        launch: Launch = self.world.backend.module(FLOW).bind(
            "gather", self.world.nodes, start=s.indptr, elements=s.indices, share=s.data, open=self._open, field=field,
            mean=mean,
        )  # fmt: skip
        return launch

    def _between(self) -> Float64:
        """Returns the part of a difference of pressures that flows in a step between neighbours, and from elements to
        drained nodes of theirs, which the means at nodes are blind to: one value for each body, so that no fluid is
        lost, (m,) [-]. A plate one cell of six tetrahedra thick, drained on both sides, has the slowest rate of its
        series, pi^2 k M / thickness^2."""
        found = np.zeros(len(self.elements))
        for body in self.bodies:
            own = self.owner == body.index
            rate = (self.mobility * self.storage)[own].mean() / np.cbrt(self.volume[own].mean()) ** 2
            fastest = SEALED if self._open[body.nodes].all() else DRAINED
            found[own] = -np.expm1(-fastest * self.world.dt * rate)
        return found

    def _stages(self) -> list[Launch]:
        """Returns the launches of the flow, from `pressure` to `_even`."""
        before, last, found = self.pressure, self.pressure, list[Launch]()
        for j in range(1, self.stages + 1):
            out, full = (self._odd if j % 2 else self._even), 2 / (self.stages * (self.stages + 1))
            mu, nu, step = (1.0, 0.0, full) if j == 1 else ((2 * j - 1) / j, (1 - j) / j, (2 * j - 1) / j * full)
            launch = self.world.backend.module(FLOW).bind(
                "stage", self.world.nodes, start=self._flow.indptr, columns=self._flow.indices, flow=self._flow.data,
                rate=self._rate, mu=mu, nu=nu, step=step, last=last, before=before, out=out,
            )  # fmt: skip
            found.append(launch)
            before, last = last, out
        return found

    def _number(self, product: float) -> int:
        """Returns the even number of stages that are stable. product: largest rate times the step [-]."""
        stages = 2
        while SAFETY * (stages * stages + stages) < product and stages <= MOST_STAGES:
            stages += 2
        if stages > MOST_STAGES:
            allowed = SAFETY * (MOST_STAGES * MOST_STAGES + MOST_STAGES) / product
            names = ", ".join(repr(body.name) for body in self.bodies)
            raise InputError(
                f"object {names}, effect poroelasticity: the fluid flows too fast for dt = {self.world.dt:g} s and the "
                f"mesh; allowed here: a mobility {allowed:.2g} times as large, or that part of dt"
            )
        return stages

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w = self.world
        elements: Launch = w.backend.module(ELEMENTS).bind(
            "elements", len(self.elements), tets=self.elements, x=w.x, v=w.predictor, gradients=self.gradients,
            volume=self.volume, biot=self.biot, coupling=self.coupling,
            stiffness=self.stiffness, h=w.force_coefficient, tangent=w.force_coefficient * w.dx_dv, **self.memory,
            corners=self.corners, edges=self.edges,
        )  # fmt: skip
        return [elements, *self.gathers(system, stencil, accumulate)]

    def energies(self) -> ElementEnergies:
        """V p_e^2 / (2 M), p_e the pressure before the fluid flows [J]."""
        launch = self.world.backend.module(ELEMENTS).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, coupling=self.coupling, storage=self.storage, **self.memory, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def _open_nodes(world: World, listed: list[tuple[Body, Any]]) -> Float64:
    """Returns 1, or 0 at nodes that are drained, (n,)."""
    found = np.ones(world.nodes)
    for body, params in listed:
        if params.drained is None:
            continue
        chosen = where.nodes(params.drained, body.mesh)
        if not chosen.any():
            raise InputError(
                f"object {body.name!r}: poroelasticity drained = {params.drained!r} holds 0 of {len(chosen)} nodes; it "
                "must hold one or more"
            )
        found[body.nodes] = ~chosen
    return found


def build(world: World, listed: list[tuple[Body, Any]]) -> Poroelasticity:
    """The fluid of all listed bodies; raises InputError for nodes to drain that are not there, and for a fast fluid."""
    return Poroelasticity(world, listed)
