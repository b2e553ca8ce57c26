# SPDX-License-Identifier: MIT
"""Wind: drag of a fluid that flows past an object, or through which it moves: air, or water all around it.

At each corner of a triangle of the surface, with the outward normal n, the area A, and u = velocity - v of the fluid
past the corner ::

    f = -1/2 density (A / 3) drag min(0, u . n)^2 n  +  1/2 density (A / 3) friction |t| t,    t = u - (u . n) n

the first a pressure on faces that the fluid meets, the second along all faces. So a plate across the wind gets
1/2 density drag A u^2 as in tables of drag coefficients, faces in the lee nothing, and a sphere half of its section
times as much. The wind is the same everywhere: no face shelters another, there is no lift but that of inclined faces,
and no mass of fluid moves along. `velocity` is that of the scene, after the pose; it is live.

A has minus the derivative of f by the velocities, which is positive semi-definite and couples no nodes; how areas turn
is left out, as for every load that follows a surface (traction.py). A worker that builds matrices itself does not know
velocities, so they are sent to it. With ros2 and explicit substeps it is not in A, which limits the step of light
bodies in water: h density drag |u| A has to stay below the mass. In a quasi-static scene v counts as 0. What the fluid
does is work.

`where` chooses triangles, all of whose nodes are in it; left out, it is all of the surface but the walls of closed
cavities, which the fluid does not reach.

Usual ranges: density of air 1.2, of water 1000 kg/m3; drag 1 to 2 of plates, 0.9 where a sphere's 0.45 is to come out;
friction 0.002 to 0.01; velocity to 30 m/s in air.

Sources: Hoerner, Fluid-Dynamic Drag, 1965 (coefficients); Wejchert and Haumann, Animation aerodynamics, SIGGRAPH 1991
(the force of a flow on triangles).
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sim_server.arrays import Int32
from sim_server.backends.base import Launch
from sim_server.effects._loads import LoadingEffect
from sim_server.effects._surfaces import Surfaces
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import NotNegative, Parameters, Vector, Where

SCOPE = "object"
TEXT = "effects/wind.cu"


class Params(Parameters):
    where: Where | None = Field(default=None, description="triangles of the surface, by their nodes [m]")
    velocity: Annotated[Vector, Live(-30, 30)] = Field(default=(0.0, 0.0, 0.0), description="of the fluid [m/s]")
    density: Annotated[NotNegative, Live(0, 4, relative=True)] = Field(default=1.2, description="of it [kg/m3]")
    drag: Annotated[NotNegative, Live(0, 2)] = Field(default=1.2, description="pressure on faces that it meets [-]")
    friction: Annotated[NotNegative, Live(0, 0.1)] = Field(default=0.0, description="along all faces [-]")


def _law(params: Params) -> list[float]:
    return [*params.velocity, 0.5 * params.density * params.drag, 0.5 * params.density * params.friction]


class Wind(LoadingEffect):
    """Drag on the surfaces of all listed bodies. face (t, 4): normal and a third of the area of each triangle [m2]."""

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world)
        self.surfaces = Surfaces(world, "wind", listed)
        self.law = world.follow("wind", compute=self.surfaces.of_triangles(_law))
        self.face = np.zeros((len(self.surfaces.corners), 4))
        world.backend.keep(self.face)

    @property
    def known_to_workers(self) -> bool:
        """False: its part of A depends on velocities."""
        return False

    @property
    def element_nodes(self) -> list[Int32]:
        return [self.surfaces.corners[:, 0]]

    def _launches(self, kernel: str, system: System, **more: Any) -> list[Launch]:
        w, s, text = self.world, self.surfaces, self.world.backend.module(TEXT)
        faces = text.bind("faces", len(s.corners), corner=s.corners, x=w.x, face=self.face)
        drag = text.bind(
            kernel, w.nodes, start=s.start, slot=s.slot, face=self.face, law=self.law, v=w.v, moves=float(w.inertia),
            h=w.force_coefficient, accumulate=self.adds_to_load, b=system.b, load=self.load, **more,
        )  # fmt: skip
        return [faces, drag]

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        if self.world.forces_alone:
            return self._launches("forces", system)
        return self._launches("drag", system, block=system.block)

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        return self._launches("forces", system)


def build(world: World, listed: list[tuple[Body, Any]]) -> Wind:
    """Drag on the listed objects; raises InputError for a part without triangles."""
    return Wind(world, listed)
