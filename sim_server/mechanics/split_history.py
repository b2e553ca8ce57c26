# SPDX-License-Identifier: MIT
"""Epochs of bodies that are split while steps run: from which step on which pattern of A holds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from sim_server.arrays import Int32
from sim_server.mechanics.splitting import KEY

if TYPE_CHECKING:
    from sim_server.mechanics.system import System
    from sim_server.scene import Scene

Pattern = tuple[Int32, Int32]
KEPT = 64  # epochs of a body whose patterns are kept, for factors that come late


class Update(Protocol):
    """New values of parameters on their way to the loop, by key. taken: steps completed when it took them, below 0:
    it has not."""

    values: dict[str, str]

    @property
    def taken(self) -> int: ...


@dataclass(frozen=True)
class _Change:
    update: Update
    pattern: Pattern
    scene: Scene


class SplitHistory:
    """Epochs of all bodies, 1 at the start and one more with each change of what a body is split into.

    The matrix of a step is of the epoch that `at` returns for the steps completed before it.
    """

    def __init__(self, system: System):
        self._system, bodies = system, system.world.bodies
        self._start = {b.name: system.body_pattern(b.first, b.last) for b in bodies}
        self._changes: dict[str, deque[_Change]] = {b.name: deque(maxlen=KEPT) for b in bodies}
        self._dropped = {b.name: 0 for b in bodies}  # changes that are no longer kept

    def on_set(self, update: Update, scene: Scene) -> None:
        """Takes note of parameters that were given to the loop."""
        followed = self._system.followed
        for body in self._system.world.bodies:
            if followed is None or KEY.format(body.name) not in update.values:
                continue
            changes = self._changes[body.name]
            if len(changes) == KEPT and changes[0].update.taken >= 0:
                self._dropped[body.name] += 1
                self._start[body.name] = changes[0].pattern
            pattern = followed.body_pattern(scene, body.first, body.last)
            changes.append(_Change(update, pattern, scene))

    def at(self, name: str, step: int) -> int:
        """Returns the epoch of an object in the matrix assembled after `step` completed steps."""
        return 1 + self._dropped[name] + sum(0 <= change.update.taken <= step for change in tuple(self._changes[name]))

    def pattern(self, name: str, epoch: int) -> Pattern:
        """Returns row_start and columns of A of an object in an epoch, nodes numbered from 0."""
        taken = [change for change in tuple(self._changes[name]) if change.update.taken >= 0]
        number = epoch - 1 - self._dropped[name]
        return self._start[name] if number <= 0 else taken[number - 1].pattern

    def scene(self, name: str, epoch: int) -> Scene | None:
        """Returns the scene with the parameters of an epoch; None: that of the start."""
        taken = [change for change in tuple(self._changes[name]) if change.update.taken >= 0]
        number = epoch - 1 - self._dropped[name]
        return None if number <= 0 else taken[number - 1].scene
