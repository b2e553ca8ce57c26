# SPDX-License-Identifier: MIT
"""What actions do to the copies of a scene: forces on nodes, or targets of grabs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_server.arrays import Float64
from sim_server.embedded.simulation import OURS, Simulation
from sim_server.errors import InputError
from sim_server.gym.copies import Copies, Select

ALWAYS = 1e30  # s, the duration of a grab


class Actions:
    """What all kinds have in common: a vector (3,) of a bounded length in each component for each of the places `at`.

    at: a choice of nodes (Copies.nodes), or a list of such. largest: of a component [of the unit of the vector]
    """

    forces = False  # whether the simulation needs room for external forces

    def __init__(self, at: Select | Sequence[Select], largest: float):
        listed = isinstance(at, list | tuple) and not all(isinstance(each, int) for each in at)
        self.at: list[Any] = list(at) if listed else [at]  # type: ignore[arg-type]
        if not self.at:
            raise InputError("at = []: actions need a place")
        self.largest = _positive(largest, type(self).__name__)
        self.effects: dict[str, Any] = {}  # that they need of objects

    def connect(self, simulation: Simulation, copies: Copies) -> None:
        """Finds the nodes in a simulation of copies. Raises InputError."""
        found = [copies.nodes(simulation, each, "at") for each in self.at]
        self.objects, self.rows = [name for name, _ in found], [rows for _, rows in found]

    def begin(self, copies: list[int]) -> None:
        """Is told which copies begin again, after they were reset."""

    def apply(self, actions: Float64) -> None:
        """Has actions (copies, places, 3) act on the next steps."""
        raise NotImplementedError


class Forces(Actions):
    """Each vector of an action is a force [N], shared equally by the nodes at its place.

    >>> Forces("tip", largest=5.0)  # N in each component; at: also "X > 0.09", [3, 7], or a list of places
    """

    forces = True

    def connect(self, simulation: Simulation, copies: Copies) -> None:
        super().connect(simulation, copies)
        self._simulation = simulation
        self._force = np.zeros((len(simulation.inside.world.x), 3))

    def apply(self, actions: Float64) -> None:
        self._force[...] = 0
        for rows, given in zip(self.rows, actions.transpose(1, 0, 2), strict=True):
            self._force[rows] += given[:, None] / rows.shape[1]
        self._simulation.forces = self._force


class Grabs(Actions):
    """Each vector of an action is where the grabbed point is drawn to: its distance from where the point began [m].

    The point is a node; it and the nodes within `radius` [m] are tied to the target by springs of `stiffness` in all
    [N/m], whose force is at most max_force [N].

    >>> Grabs("tip", reach=0.05, stiffness=500.0, max_force=20.0)
    """

    def __init__(
        self, at: Select | Sequence[Select], reach: float, stiffness: float, max_force: float, radius: float = 0.0
    ):
        super().__init__(at, reach)
        self.stiffness, self.max_force = _positive(stiffness, "stiffness"), _positive(max_force, "max_force")
        if not 0 <= radius < np.inf:
            raise InputError(f"radius = {radius:g} m: must be 0 or more")
        self.radius = radius
        n = len(self.at)
        self.effects = {"touch": {"max_force": max_force, "max_total_force": n * max_force, "max_interactions": n}}

    def connect(self, simulation: Simulation, copies: Copies) -> None:
        super().connect(simulation, copies)
        for place, rows in zip(self.at, self.rows, strict=True):
            if rows.shape[1] != 1:
                raise InputError(
                    f"at = {place!r}: a grab is at one node, with others within its radius; {rows.shape[1]} are there"
                )
        self._touch, self._copies = simulation.inside.touch, copies
        self._start = np.stack([simulation.inside.world.x[rows[:, 0]] for rows in self.rows], axis=1)
        self._ids = np.zeros((copies.number, len(self.at)), int)  # of interactions; 0: none yet

    def begin(self, copies: list[int]) -> None:
        self._ids[copies] = 0

    def apply(self, actions: Float64) -> None:
        assert self._touch is not None
        with self._touch.together():
            for copy, place in np.ndindex(self._ids.shape):
                self._draw(copy, place, self._start[copy, place] + actions[copy, place])

    def _draw(self, copy: int, place: int, target: Float64) -> None:
        """Moves the target of a grab, which is made if there is none."""
        touch, (x, y, z) = self._touch, target.tolist()
        assert touch is not None
        try:
            if self._ids[copy, place]:
                touch.move(OURS, self._ids[copy, place].item(), (x, y, z))
                return
            name = self._copies.names[self.objects[place]][copy]
            a, b, c = self._start[copy, place].tolist()
            made = touch.grab(OURS, name, (a, b, c), self.radius, (x, y, z), self.stiffness, self.max_force, ALWAYS)
            self._ids[copy, place] = made.id
        except ValueError as error:
            raise InputError(f"grab: {error}") from None


def _positive(value: float, name: str) -> float:
    if not 0 < value < np.inf:
        raise InputError(f"{name} = {value:g}: must be above 0 and finite")
    return float(value)
