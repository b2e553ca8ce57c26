# SPDX-License-Identifier: MIT
"""Puts objects, or the whole scene, back to where they began, while the loop stands still between two steps.

The state is that before the first step, but for step number and time, which go on, and for what is a cache: factors,
their corrections and what is known of costs stay in use. Keyframes are those of the time since the reset.
"""

from sim_server.simulation import Simulation
from sim_server.state.arrays import state_arrays


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

    def reset(self, name: str = "") -> None:
        """Puts an object with its holders, or the whole scene (no name), back. Raises KeyError for an unknown one.

        Of all that touches the object, or is tied to it, the forces, friction and breaks are forgotten.
        """
        s = self._simulation
        bodies = [s.world.body(name).index] if name else [b.index for b in s.world.bodies]
        for array, value in self._arrays:
            if not name:
                array.write(value)
            elif array.rows is not None:
                now, rows = array.read(), array.rows(bodies[0])
                now[rows] = value[rows]
                array.write(now)
        time = s.engine.loop.start_time + s.engine.step * s.world.dt
        for mover in s.movers:
            mover.restart([k for k, o in enumerate(mover.listed) if not name or getattr(o, "object", "") == name], time)
        s.engine.restart(bodies)
