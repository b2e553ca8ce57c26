# SPDX-License-Identifier: MIT
"""Uniform gravity on every object of the scene.

Nodal force::

    f_i = m_i g

with the lumped mass m_i [kg] of node i. The force depends on neither x nor v, so nothing enters the system matrix.

Usual values: (0, -9.81, 0) m/s2 with y up, (0, 0, -9.81) with z up. With g = 0, leave the effect out instead: a scene
that does not list gravity has none. The static sag of a cantilever of length L, area A and second moment I under its
own weight is rho g A L^4 / (8 E I) as long as that is small against L (Euler and Bernoulli), a useful check.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.effects._base import Effect
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import Live
from sim_server.scene.parameters import Parameters, Vector

SCOPE = "scene"


class Params(Parameters):
    g: Annotated[Vector, Live(-20, 20)] = Field(default=(0.0, -9.81, 0.0), description="acceleration [m/s2]")


class Gravity(Effect):
    """Adds the weight: b += h m g."""

    def __init__(self, world: World):
        self.world = world
        world.gravity_of = _gravity_of
        self.g = world.gravity()

    def cuttable(self, body: Body) -> bool:
        return True

    def splittable(self, body: Body) -> bool:
        return True

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w = self.world
        return [
            self.world.backend.module("effects/gravity.cu").bind(
                "gravity", w.nodes, mass=w.mass, g=self.g, h=w.force_coefficient, b=system.b
            )
        ]

    def balance_arrays(self) -> dict[str, Float64]:
        return {"gravity": self.g}

    def energy(self) -> float:
        """Potential energy -sum m g . x, zero at the origin [J]."""
        return -float(self.world.mass @ (self.world.x @ self.g))


def _gravity_of(scene: Scene) -> Float64:
    params = scene.effects["gravity"]
    assert isinstance(params, Params)
    return np.array(params.g, np.float64)


def build(world: World, listed: list[tuple[Body, Any]]) -> Gravity:
    """Gravity on all nodes."""
    return Gravity(world)
