# SPDX-License-Identifier: MIT
"""Positions and velocities of a simulation, wherever they are."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_server.simulation import Simulation


def put(sim: Simulation, array: NDArray[np.float64], value: ArrayLike) -> None:
    """Into an array of the world, and on a GPU into its twin; while the loop stands still."""
    array[...] = value
    backend = sim.world.backend
    if backend.name == "gpu":
        twin = backend.twin(array)
        twin.set(array.astype(twin.dtype))
        sim.engine.restart_energy()  # on a CPU the loop sees it by itself
        backend.cp.cuda.get_current_stream().synchronize()  # not the device: a capture may be under way
