# SPDX-License-Identifier: MIT
"""The interactions of clients that acted in steps, for the messages of these steps."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.recording.object_steps import Additions
from sim_server.service.commands import Commands
from sim_server.simulation import Simulation


class ActingInteractions:
    """Keeps interactions until the messages of the steps in which they acted are made.

    commands: whose interactions these are; None: there are none
    """

    def __init__(self, simulation: Simulation, commands: Commands | None):
        self.simulation, self.commands = simulation, commands
        self._interactions: dict[int, pb.Interaction] = {}
        self._over: set[int] = set()  # ids of those of them that act no more

    def note(self) -> None:
        """Takes note of the interactions that act in steps, of which messages tell."""
        if self.commands is None or self.simulation.touch is None:
            return
        known = {i.id: i for i in self.commands.interactions()}
        clock, dt = float(self.simulation.system.clock[0]), self.simulation.world.dt
        for id in set(self._interactions) - set(known) - self._over:  # it acted up to the step under way at most
            interaction = self._interactions[id]
            interaction.duration = min(interaction.duration, max(clock + dt - interaction.start, 0))
            self._over.add(id)
        self._interactions.update(known)

    def acting(self, records: NDArray[Any]) -> Additions:
        """Returns the interactions that acted in the steps of records."""
        additions, dt = Additions(), self.simulation.world.dt
        bodies = {body.name: body.index for body in self.simulation.world.bodies} if self._interactions else {}
        begin = records["time"] - dt
        for i in self._interactions.values():
            acted = (i.start <= begin + 0.5 * dt) & (begin + 0.5 * dt < i.start + i.duration)
            if i.start >= 0:
                for number in np.flatnonzero(acted & (records["body"] == bodies.get(i.object, -1))).tolist():
                    additions[number].interactions.append(i)
        return additions

    def forget(self) -> None:
        """Forgets those that are over: the messages of steps in which they acted are made."""
        for id in self._over:
            del self._interactions[id]
        self._over.clear()
