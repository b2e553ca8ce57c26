# SPDX-License-Identifier: MIT
"""Forces on all nodes that a program sets between steps, as loads of each step."""

import numpy as np

from sim_server.backends.base import Launch
from sim_server.effects._loads import LoadingEffect
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import World


class ExternalForces(LoadingEffect):
    """Adds force (n, 3) [N] to the right-hand side, by the kernel of dead loads (effects/traction.cu).

    It is an array for kernels, so that what is written to it, or to its twin on a GPU, acts from the next step on.
    """

    name = "external forces"  # as no scene can list

    def __init__(self, world: World):
        super().__init__(world)
        self.force = np.zeros((world.nodes, 3))
        world.backend.keep(self.force)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        w, nothing = self.world, np.zeros(0)
        load: Launch = w.backend.module("effects/traction.cu").bind(
            "load", w.nodes, start=np.zeros(w.nodes + 1, np.int32), triangle=np.zeros(0, np.int32), share=nothing,
            area=np.zeros((0, 3)), dead=self.force, h=w.force_coefficient, accumulate=self.adds_to_load, b=system.b,
            load=self.load,
        )  # fmt: skip
        return [load]
