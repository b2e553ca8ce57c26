# SPDX-License-Identifier: MIT
"""Puts objects, or the whole scene, back to where they began, while the loop stands still between two steps.

The state is that before the first step, but for step number and time, which go on, and for what is a cache: factors,
their corrections and what is known of costs stay in use. Keyframes are those of the time since the reset.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.state import StateArray
from sim_server.mechanics.removal import KEY
from sim_server.mechanics.splitting import KEY as SPLIT
from sim_server.simulation import Simulation
from sim_server.state.arrays import launch_arrays, state_arrays


class Start:
    """The state of a simulation before its first step, made here; `reset` goes back to it.

    Raises ValueError for a simulation that has made steps.
    """

    def __init__(self, simulation: Simulation):
        if simulation.engine.step:
            raise ValueError(f"the simulation has made {simulation.engine.step} steps: this is not where it began")
        self._simulation = simulation
        simulation.engine.prepare()
        self._arrays = [(a, a.read()) for a in state_arrays(simulation) if a.resets]

    def reset(self, *only: str) -> None:
        """Puts objects with their holders, or the whole scene (no name), back. Raises KeyError for an unknown one.

        Of all that touches the objects, or is tied to them, the forces, friction and breaks are forgotten. What was cut
        is whole again. Parameters that were set stay, and the loop has those that wait before.
        """
        s = self._simulation
        only = tuple(name for name in only if name)
        bodies = [s.world.body(name).index for name in only] or [b.index for b in s.world.bodies]
        names = [s.world.bodies[index].name for index in bodies]
        s.parameters.take_back(key.format(name) for key in (KEY, SPLIT) for name in names)
        s.engine.take_changes()
        back = self._arrays if not only else [(a, _with_rows(a, v, bodies)) for a, v in self._arrays if a.rows]
        for array, value in back:
            array.write(value)
        time = s.engine.loop.start_time + s.engine.step * s.world.dt
        for mover in s.movers:
            mover.restart([k for k, o in enumerate(mover.listed) if not only or getattr(o, "object", "") in only], time)
        if s.parameters.changed:
            self._begin_again(bodies)
        s.engine.restart(bodies)

    def _begin_again(self, bodies: Sequence[int]) -> None:
        """Makes what the scheme begins with from the present parameters: of these bodies, and of nothing else."""
        s = self._simulation
        rows, made = np.isin(s.system.body, bodies), s.integrator.still
        kept = [(a, a.read()) for a in launch_arrays(s)] if s.engine.begin else []
        for launch in s.engine.begin:
            if not launch.mailed:  # nothing pushes the bodies, and poses do not matter
                launch()
        own = [(each, s.world.backend.fetch(each)[rows]) for each in made]
        for array, value in kept:
            array.write(value)
        for each, values in own:
            each[rows] = values
            s.world.backend.push(each)


def _with_rows(array: StateArray, start: NDArray[Any], bodies: Sequence[int]) -> NDArray[Any]:
    """Returns the array as it is, with the rows of bodies as they were at the start."""
    assert array.rows is not None
    now = array.read()
    for rows in [array.rows(body) for body in bodies]:
        now[rows] = start[rows]
    return now
