# SPDX-License-Identifier: MIT
"""Rest shapes of linear elements: those of the mesh, or what growth makes of each by itself."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.mechanics.removal import present
from sim_server.mechanics.world import Body, World
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.scene import Scene


class RestShape:
    """Volumes (m,) [m3] and rest gradients (m, 3, 3) [1/m] of elements (m, 4).

    bodies: whose elements they are, one after another before `order` (m,) took them. of: tables of the scene that they
    follow, none if no body lists growth or cutting
    """

    def __init__(self, world: World, bodies: Sequence[Body], elements: Int32, order: NDArray[np.integer]):
        self._volume, self._gradients = shape_gradients(world.rest, elements)
        self.of: tuple[str, ...] = ()
        self._stretches: Callable[[Scene], Float64] | None = None
        self._present: Callable[[Scene], Float64] | None = None
        if any("growth" in body.effects for body in bodies):
            from sim_server.effects.growth import stretches_of  # scenes without it do not import it

            self.of, stretches = ("growth",), stretches_of(bodies)
            self._stretches = lambda scene: stretches(scene)[order]

        if any("cutting" in body.effects for body in bodies):
            self.of += ("cutting",)
            self._present = lambda scene: present(scene, bodies)[order]

    def present(self, scene: Scene) -> Float64:
        """Returns 1 for elements that are there and 0 for those that were removed, (m,); (1,) if none can be."""
        return np.ones(1) if self._present is None else self._present(scene)

    def volume(self, scene: Scene) -> Float64:
        """Returns the volumes by the parameters of a scene."""
        return self._volume if self._stretches is None else self._volume * self._stretches(scene).prod(axis=1)

    def gradients(self, scene: Scene) -> Float64:
        """Returns the gradients by the parameters of a scene."""
        return self._gradients if self._stretches is None else self._gradients / self._stretches(scene)[:, None, :]

    def followed(self, world: World, compute: Callable[[Scene], NDArray[Any]]) -> Any:
        """Returns compute(scene), which uses these shapes, as an array that follows them."""
        return world.follow(*self.of, compute=compute) if self.of else np.ascontiguousarray(world.at_start(compute))
