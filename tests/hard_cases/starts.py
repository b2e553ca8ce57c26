# SPDX-License-Identifier: MIT
"""What is done to a bar before its first step, in place: states that no run should reach by itself."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation

Start = Callable[[Simulation], None]
Reals = NDArray[np.float64]


def nothing(sim: Simulation) -> None:
    """The pose of the scene, at rest."""


def _placed(change: Callable[[Reals, np.random.Generator], Reals], seed: int = 0) -> Start:
    """New positions of the free nodes; fixed ones stay."""

    def start(sim: Simulation) -> None:
        free = sim.world.free > 0
        sim.world.x[free] = change(sim.world.x, np.random.default_rng(seed))[free]

    return start


def mirrored(axis: int) -> Start:
    """Inside out: every element mirrored at the bar's middle plane, J = -1."""

    def mirror(x: Reals, _: np.random.Generator) -> Reals:
        x = x.copy()
        x[:, axis] = x[:, axis].min() + x[:, axis].max() - x[:, axis]
        return x

    return _placed(mirror)


def _swapped(x: Reals, _: np.random.Generator) -> Reals:
    heights, layer = np.unique(x[:, 2].round(9), return_inverse=True)
    partner = np.arange(len(heights))
    partner[1:-1:2], partner[2::2] = partner[2::2].copy(), partner[1:-1:2].copy()
    out = x.copy()
    out[:, 2] = heights[partner[layer]]
    return out


swapped_layers = _placed(_swapped)


def flattened(*axes: int) -> Start:
    """All nodes at 0.5 m along the axes, with noise of 1 um: a plane, a line or (three axes) a point."""

    def flatten(x: Reals, rng: np.random.Generator) -> Reals:
        x = x.copy()
        x[:, list(axes)] = 0.5
        return x + 1e-6 * rng.normal(size=x.shape)

    return _placed(flatten)


def randomly_placed(seed: int) -> Start:
    """All free nodes anywhere in the bounding box."""
    return _placed(lambda x, rng: rng.uniform(x.min(axis=0), x.max(axis=0), x.shape), seed)


random_in_box = randomly_placed(0)


def stretched(factor: float) -> Start:
    """Pulled along Z."""
    return _placed(lambda x, _: x * [1, 1, factor])


def spinning(speed: float) -> Start:
    """About X through the centre of mass [rad/s]."""

    def start(sim: Simulation) -> None:
        w = sim.world
        w.v[:] = np.cross([speed, 0, 0], w.x - w.mass @ w.x / w.mass.sum())

    return start


def twisting(speed: float) -> Start:
    """About Z, the more the farther from the held end: the free end at so many rad/s."""

    def start(sim: Simulation) -> None:
        w = sim.world
        along = w.x[:, 2] / w.x[:, 2].max()
        w.v[:] = speed * along[:, None] * np.cross([0, 0, 1], w.x - [0.5, 0.5, 0])

    return start


def thrown(speed: float) -> Start:
    """Sideways, the more the farther from the held end: the free end at so many m/s."""

    def start(sim: Simulation) -> None:
        w = sim.world
        w.v[:, 1] = speed * (w.x[:, 2] / w.x[:, 2].max()) ** 2

    return start


def mass_times(factor: float, below: float) -> Start:
    """Nodal masses with Z < below multiplied; a scene has one density, so they are changed in the arrays."""

    def start(sim: Simulation) -> None:
        sim.world.mass[sim.world.rest[:, 2] < below] *= factor

    return start
