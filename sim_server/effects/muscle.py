# SPDX-License-Identifier: MIT
"""Muscle: fibres that contract by themselves, beside a law for what they are embedded in. A signal activates them.

Along a direction a of unit length at rest, in the coordinates of the rest shape before the pose, with the stretch l of
the fibre and its direction now n = F a / l::

    T = stress activation pulse(t) L(l)            force by area at rest [Pa]
    P = T n a^T                                    first Piola-Kirchhoff stress
    L(l) = max(0, 1 - ((l - optimum) / width)^2)   width = 0 (default): 1

With width = 0 T does not depend on the length: a bar of section A (at rest) that is held pulls with T A, and one that
is free shortens to l = 1 - T / young without contraction across. Sarcomeres have optimum 1 and width about 0.5.

`activation` (0 to 1, live) is the signal of a client. With a `period` [s] the muscle beats by itself: activation is
then multiplied by

    pulse(t) = 16 s^2 (1 - s)^2,   s = fraction(t / period - phase) / duty    where s < 1, else 0

which rises from 0 to 1 and falls to 0 within the part `duty` of the period, with a slope of 0 at both ends. t is the
time at the end of the step in implicit schemes of one stage (in generalized_alpha that at which forces balance), and
the middle of the step in ros2 and with explicit substeps, where it is of order 2 as a mean. A `period` that changes
while steps run leaves t as it is, so the phase jumps; so does a reset, after which beats go on.

`stress` may be a list of regions { where, stress, direction, activation, period, phase, duty, optimum, width }: so
directions vary over a body, parts are activated one by one, and phases make waves.

The stiffness matrix has (T / l) (I - n n^T) across the fibre, and dT/dl along it where that is positive. On the
descending branch of L, l > optimum, dT/dl < 0 is left out, which takes the order of convergence from Newton-Raphson and
not its answer. Forces are loads: what they do counts as work, and they have no potential energy.

Usual ranges: skeletal muscle 100 to 400 kPa, heart 50 to 130 kPa, smooth muscle 30 to 300 kPa; a period of 0.2 to 1.2 s
for hearts, 0.5 to 2 s for swimmers and crawlers.

Sources: Zajac, Muscle and tendon, Critical Reviews in Biomedical Engineering 17, 1989 (activation, force and length);
Blemker, Pinsky and Delp, A 3D model of muscle, Journal of Biomechanics 38, 2005 (active stress in a continuum).
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect, check_beside_law
from sim_server.effects._hyperelastic import Constant, Law, Tetrahedra
from sim_server.effects._loads import LoadingEffect
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import NotNegative, Vector, complaint

SCOPE = "object"


def _not_zero(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    size = max(map(abs, direction))
    if not 1e-100 < size < 1e100:
        raise complaint("a direction must not be zero, nor of a length that is out of bounds (1e-100 to 1e100)")
    return direction


def _beat(period: float) -> float:
    if period != 0 and not period >= SHORTEST:
        raise complaint(f"must be 0, or at least {SHORTEST:g} s")
    return period


SHORTEST = 1e-6  # s
TEXT = "effects/muscle.cu"
ONE = Live(0, 1)
PACKED = ("stress", "activation", "period", "phase", "duty", "optimum", "width")  # as the kernel text has them
LAW = Law(
    "muscle",
    (
        Constant(
            "stress", NotNegative, "if fully activated [Pa], or a list of regions", live=Live(0, 4, relative=True)
        ),
        Constant("direction", Annotated[Vector, AfterValidator(_not_zero)], "of the fibres at rest", live=Live()),
        Constant("activation", Annotated[float, Field(ge=0, le=1)], "of the fibres [-]", 1.0, live=ONE),
        Constant(
            "period", Annotated[NotNegative, AfterValidator(_beat)], "of beats [s]; 0: none", 0.0, live=Live(0, 3)
        ),
        Constant("phase", float, "by which beats are late, in periods [-]", 0.0, live=ONE),
        Constant("duty", Annotated[float, Field(gt=0, le=1)], "part of the period [-]", 0.5, live=Live(0.05, 1)),
        Constant("optimum", Annotated[float, Field(gt=0)], "stretch of most force [-]", 1.0, live=Live(0.5, 1.5)),
        Constant("width", NotNegative, "of the range of stretches with force [-]; 0: all", 0.0, live=ONE),
    ),
    pack=lambda values: [values[name] for name in PACKED],
    refuses=False,
)
Params = LAW.parameters()


class Muscle(Tetrahedra, LoadingEffect):
    """constants (7, m) and directions (3, m), as the kernel text has them; forces (4, m, 3): of corners [N]."""

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        Tetrahedra.__init__(self, world, listed)
        LoadingEffect.__init__(self, world)
        self.constants = self.packed(LAW)
        self.directions = world.follow(LAW.name, compute=self._directions)
        self.forces = np.zeros((4, len(self.elements), 3))
        world.backend.keep(self.forces)
        self._beats = world.at_start(self._beating)

    def join(self, others: Sequence[Effect]) -> None:
        check_beside_law(self, self.bodies, others)

    def _directions(self, scene: Scene) -> Float64:
        directions = np.concatenate([v["direction"] for v in self.values_in(scene, LAW)])[self.order]
        return np.asarray((directions / np.linalg.norm(directions, axis=1, keepdims=True)).T)

    def _beating(self, scene: Scene) -> bool:
        return any((values["period"] > 0).any() for values in self.values_in(scene, LAW))

    @property
    def known_to_workers(self) -> bool:
        """False with a period at the start: workers do not know the time."""
        return not self._beats

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w, m = self.world, len(self.elements)
        ahead = w.dt * (0.5 if w.forces_alone else w.balance_point)
        elements = w.backend.module(TEXT).bind(
            "elements", m, tets=self.elements, x=w.x, gradients=self.gradients, volume=self.volume,
            constants=self.constants, directions=self.directions, clock=system.clock, ahead=ahead, corners=self.corners,
            edges=self.edges, forces=self.forces, **self._of_a_step(),
        )  # fmt: skip
        load = w.backend.module("effects/muscle_load.cu").bind(
            "load", w.nodes, elements=m, start=stencil.corner_start, slots=stencil.corners, forces=self.forces,
            accumulate=self.adds_to_load, load=self.load,
        )  # fmt: skip
        return [elements, *self.gathers(system, stencil, accumulate), load]

    def energies(self) -> ElementEnergies | None:
        return None


def build(world: World, listed: list[tuple[Body, Any]]) -> Muscle:
    """The fibres; raises InputError for an element in no region."""
    return Muscle(world, listed)
