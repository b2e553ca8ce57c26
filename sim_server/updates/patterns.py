# SPDX-License-Identifier: MIT
"""Patterns of the matrices of objects, by the epochs of those that are split while steps run."""

from __future__ import annotations

from collections.abc import Mapping

from sim_server.mechanics.split_history import Pattern, SplitHistory
from sim_server.simulation import Simulation


class Patterns:
    """Row_start and columns of A by object, nodes numbered from 0.

    given: of objects that keep theirs; history: of those that are split, None if none are
    """

    def __init__(self, given: Mapping[str, Pattern], history: SplitHistory | None = None):
        self._given, self._history = given, history

    @classmethod
    def of(cls, simulation: Simulation) -> Patterns:
        """Returns those of a simulation."""
        system = simulation.system
        given = {b.name: system.body_pattern(b.first, b.last) for b in simulation.world.bodies}
        return cls(given, simulation.splits)

    @property
    def change(self) -> bool:
        """True if objects may be split."""
        return self._history is not None

    def at(self, name: str, epoch: int) -> Pattern:
        """Returns that of an object in an epoch."""
        return self._given[name] if self._history is None else self._history.pattern(name, epoch)
