# SPDX-License-Identifier: MIT
"""Common part of the effects whose forces are loads: the energy balance counts their work.

All of them add to one array of the world, in the order of their launches; the first of them writes it.
"""

from sim_server.arrays import Float64
from sim_server.effects._base import Effect
from sim_server.mechanics.world import World


class LoadingEffect(Effect):
    """Base of these effects.

    load (n, 3): forces of all of them on the nodes in the last evaluation [N]
    """

    def __init__(self, world: World):
        self.world = world
        self.load = world.share_load(self)

    @property
    def adds_to_load(self) -> int:
        """1 if launches of another effect have written `load` before those of this one, else 0."""
        first = min(self.world.loading, key=lambda effect: effect.elements is None)  # as Simulation.launches has them
        return int(first is not self)

    def balance_arrays(self) -> dict[str, Float64]:
        return {"load": self.load}
