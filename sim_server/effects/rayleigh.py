# SPDX-License-Identifier: MIT
"""Rayleigh damping: a force against velocity, proportional to mass and to stiffness.

Damping matrix and force::

    C = mass M + stiffness (-K),   f = -C v,   K = df/dx of the elastic effects (at rest, -K is positive semi-definite)

A mode of angular frequency w is damped with the ratio  zeta = mass / (2 w) + stiffness w / 2: `mass` acts on slow
motion (falling and swinging as a whole), `stiffness` on fast vibration. In the matrix of backward Euler,
A = (1 + h mass) M + h (h + stiffness) (-K): stiffness damping makes A stiffer, by the factor 1 + stiffness / h, and
the system harder to solve; at h = 0.02 s, stiffness = 0.1 s multiplies the stiff part by six.

In a quasi-static scene nothing moves, so the damping is left out.

Usual ranges: mass 0 to 1 1/s, stiffness 0 to 0.1 s. SOFA's beam scenes use 0.1 for both; for visible swinging take
stiffness = 0, since backward Euler damps fast modes by itself.

Source: Rayleigh, The Theory of Sound, 1877; Hughes, The Finite Element Method, section 9.3.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.effects._base import Effect, params_in
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import Parameters

SCOPE = "object"
KEYS = ("mass", "stiffness")


class Params(Parameters):
    mass: Annotated[float, Live(0, 20)] = Field(default=0.0, ge=0, description="mass-proportional coefficient [1/s]")
    stiffness: Annotated[float, Live(0, 0.1)] = Field(
        default=0.0, ge=0, description="stiffness-proportional coefficient [s]"
    )


class Drag(Effect):
    """The damping of the mass, b -= h alpha m v; that of the stiffness is in world.stiffness_coefficient."""

    def __init__(self, world: World, bodies: Sequence[Body]):
        self.world, self.bodies = world, bodies
        self.alpha = world.alpha_of_nodes()

    def unchangeable(self, scene: Scene) -> Mapping[tuple[int, str], str]:
        found: dict[tuple[int, str], str] = {}
        if not self.world.inertia:
            return {(b.index, key): "nothing moves in a quasi-static scene" for b in self.bodies for key in KEYS}
        alpha, beta = self.world.damping(scene)
        begun = "the scene began with 0 at all objects, so that its steps have no kernel for it"
        own = "the object began with 0, so that stages without a matrix may have no kernel for it"
        if alpha.any() and not self.world.alpha.any() and not self.world.explicit:
            found |= {(b.index, "mass"): begun for b in self.bodies}
        if self.world.forces_alone:  # laws look at the bodies that they have (_hyperelastic.py, corotational.py)
            damped = (beta > 0) & (self.world.beta == 0)
            found |= {(b.index, "stiffness"): own for b in self.bodies if damped[b.index]}
        if self.world.explicit and (beta != self.world.beta).any():
            found |= {(b.index, "stiffness"): "the stable step of an explicit scheme knows it" for b in self.bodies}
        return found

    def cuttable(self, body: Body) -> bool:
        return True

    def splittable(self, body: Body) -> bool:
        return True

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w = self.world
        if not self.alpha.any() or w.explicit:  # an explicit scheme damps by world.alpha
            return []
        drag = self.world.backend.module("effects/rayleigh.cu").bind(
            "drag", w.nodes, mass=w.mass, alpha=self.alpha, v=w.v, h=w.force_coefficient, diagonal=system.diagonal,
            b=system.b,
        )  # fmt: skip
        return [drag]


def build(world: World, listed: list[tuple[Body, Any]]) -> Drag:
    """Sets world.alpha and world.beta and returns the damping of the mass; a quasi-static scene has neither."""
    bodies = [body for body, _ in listed]

    def damping(scene: Scene) -> tuple[Float64, Float64]:
        alpha, beta = np.zeros((2, len(world.bodies)))
        for body, params in zip(bodies, params_in(scene, "rayleigh", bodies), strict=True):
            alpha[body.index], beta[body.index] = params.mass, params.stiffness
        return alpha, beta

    if world.inertia:
        world.damp(damping)
    return Drag(world, bodies)
