# SPDX-License-Identifier: MIT
"""Where the iterations of a step start: a guess of dv from the solutions of the last steps.

The solutions of a smooth motion are values of a smooth function of time, so polynomials through the last ones tell the
next one with few percent or less of error, where the last one alone is off by a tenth. Each node takes the mean of
those of degree 0 to 4, weighted by what their errors were last (kernels/guess.cu). The solver starts from zero where
that is better, so a wrong guess costs an iteration or two and never the answer.

Other starts from earlier solutions, by projection: Fischer, Projection techniques for iterative solution of Ax = b with
successive right-hand sides, Comput. Methods Appl. Mech. Eng. 163 (1998). Those take a product by A for each solution.
"""

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.mechanics.world import World
from sim_server.scene import Scene

DIFFERENCES = 5  # ORDERS of the kernel


class Guess:
    """The guess and what it is made from.

    dv (n, 3): array that has the last solution after each step, world frame [m/s]
    """

    def __init__(self, world: World, dv: Float64):
        self.world, self._dv = world, dv
        self.next = np.zeros_like(dv)
        self._differences = np.zeros((len(dv), 3 * DIFFERENCES))
        world.backend.keep(self.next, self._differences)

    def extrapolate(self) -> Launch:
        """Makes the guess for the next step, after the solution of this one."""
        return self.world.backend.module("kernels/guess.cu").bind(
            "extrapolate", self.world.nodes, dv=self._dv, differences=self._differences, guess=self.next
        )


def make_guess(scene: Scene, world: World, dv: Float64) -> Guess | None:
    """Returns None for a scene whose steps start from the last solution, or solve nothing.

    That are other schemes than backward Euler, which hardly damp, so that their solutions zigzag and next to nothing
    is saved; scenes with several linearizations a step, of whose solves only the first one could begin with it; those
    with `[accuracy]`, whose estimates know the errors of the last solution, which are smoother than those of a guess
    (with one they were too small by up to 20 times where bodies are stiff); and those in which nodes are copied.
    """
    integrator = scene.integrator
    if integrator.scheme != "backward_euler" or integrator.linearizations > 1 or scene.accuracy is not None:
        return None
    return Guess(world, dv) if scene.solver.warm_start and world.splitting is None else None
