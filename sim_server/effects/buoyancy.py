# SPDX-License-Identifier: MIT
"""Buoyancy: the pressure of a fluid at rest below a level, so that objects float, sink and are squeezed.

With gravity g, height z = -x . g / |g| and the depth d = level - z, the pressure on the surface is ::

    p = density |g| max(0, d)

and node a gets -A times the integral of p N_a over each of its triangles, A the outward area as it is now and N_a its
linear shape function. Triangles that the level crosses are cut there, and the integrals are exact: the force on a
closed surface is the weight of the fluid that it displaces (Archimedes), to rounding, at the centroid of that volume.

`level` [m] is a height from the origin of the scene, against gravity: y with the usual g; it is live, and so is
`density`. The fluid is everywhere below it, also inside what is open above it, and does not reach closed cavities.
`where` chooses other triangles, all of whose nodes are in it: those of a hull, whose inside stays dry. Waves, added
mass and drag are not in it; rayleigh.mass or wind with the density of the fluid keep floating objects from bobbing on.

Nothing of it is in A, which limits the step h for very light objects alone: they float steadily with drafts above
|g| h^2 / 4 (1 mm at 20 ms, 4 cm at 0.13 s). The energy balance counts the work.

Usual ranges: density of fresh water 1000, of sea water 1025, of air 1.2 kg/m3.

Sources: Archimedes, On Floating Bodies, I.5; Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis,
section 8.5 (pressure loads).
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sim_server.arrays import Int32
from sim_server.backends.base import Launch
from sim_server.effects._loads import LoadingEffect
from sim_server.effects._surfaces import Surfaces
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import NotNegative, Parameters, Where

SCOPE = "object"
TEXT = "effects/buoyancy.cu"


class Params(Parameters):
    level: Annotated[float, Live()] = Field(description="height of the surface of the fluid, against gravity [m]")
    density: Annotated[NotNegative, Live(0, 4, relative=True)] = Field(default=1000.0, description="of it [kg/m3]")
    where: Where | None = Field(default=None, description="triangles of the surface, by their nodes [m]")


class Buoyancy(LoadingEffect):
    """Pressure of fluids on the surfaces of all listed bodies. push (t, 3, 3): forces on corners of triangles [N]."""

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world)
        self.surfaces = Surfaces(world, "buoyancy", listed)
        self.fluid = world.follow("buoyancy", compute=self.surfaces.of_triangles(lambda p: [p.level, p.density]))
        self.push = np.zeros((len(self.surfaces.corners), 3, 3))
        world.backend.keep(self.push)

    @property
    def element_nodes(self) -> list[Int32]:
        return [self.surfaces.corners[:, 0]]

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w, s, text = self.world, self.surfaces, self.world.backend.module(TEXT)
        wetted = text.bind(
            "wetted", len(s.corners), corner=s.corners, x=w.x, fluid=self.fluid, gravity=w.gravity(), push=self.push
        )
        lift = text.bind(
            "lift", w.nodes, start=s.start, slot=s.slot, push=self.push, h=w.force_coefficient,
            accumulate=self.adds_to_load, b=system.b, load=self.load,
        )  # fmt: skip
        return [wetted, lift]


def build(world: World, listed: list[tuple[Body, Any]]) -> Buoyancy:
    """The fluids around the listed objects; raises InputError without gravity, or for a part without triangles."""
    if not world.at_start(lambda scene: "gravity" in scene.effects):
        raise InputError(
            f"object {listed[0][0].name!r}: buoyancy needs gravity, which makes the pressure of the fluid; list "
            "gravity under [effects]"
        )
    return Buoyancy(world, listed)
