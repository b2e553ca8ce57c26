# SPDX-License-Identifier: MIT
"""Epochs of bodies that are split while steps run: from which step on which pattern of A holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class _Epochs:
    """Those of one body. Made anew with each change, as another thread may be reading them.

    start: pattern before the first change that is kept; dropped: changes before it, which were taken
    """

    start: Pattern
    changes: tuple[_Change, ...] = ()
    dropped: int = 0

    def taken(self) -> list[_Change]:
        return [change for change in self.changes if change.update.taken >= 0]

    def with_change(self, change: _Change) -> _Epochs:
        """Returns these with one more, and without the first one if there are too many. The loop may never have taken
        that up: it was replaced by the next one then, and has no epoch."""
        if len(self.changes) < KEPT:
            return replace(self, changes=(*self.changes, change))
        first, changes = self.changes[0], (*self.changes[1:], change)
        if first.update.taken < 0:
            return replace(self, changes=changes)
        return _Epochs(first.pattern, changes, self.dropped + 1)


class SplitHistory:
    """Epochs of all bodies, 1 at the start and one more with each change of what a body is split into.

    The matrix of a step is of the epoch that `at` returns for the steps completed before it. Several threads may ask
    while one calls `on_set`.
    """

    def __init__(self, system: System):
        self._system = system
        self._of = {b.name: _Epochs(system.body_pattern(b.first, b.last)) for b in system.world.bodies}

    def on_set(self, update: Update, scene: Scene) -> None:
        """Takes note of parameters that were given to the loop."""
        followed = self._system.followed
        for body in self._system.world.bodies:
            if followed is None or KEY.format(body.name) not in update.values:
                continue
            change = _Change(update, followed.body_pattern(scene, body.first, body.last), scene)
            self._of[body.name] = self._of[body.name].with_change(change)

    def at(self, name: str, step: int) -> int:
        """Returns the epoch of an object in the matrix assembled after `step` completed steps."""
        epochs = self._of[name]
        return 1 + epochs.dropped + sum(0 <= change.update.taken <= step for change in epochs.changes)

    def pattern(self, name: str, epoch: int) -> Pattern:
        """Returns row_start and columns of A of an object in an epoch, nodes numbered from 0."""
        epochs = self._of[name]
        number = epoch - 1 - epochs.dropped
        return epochs.start if number <= 0 else epochs.taken()[number - 1].pattern

    def scene(self, name: str, epoch: int) -> Scene | None:
        """Returns the scene with the parameters of an epoch; None: that of the start."""
        epochs = self._of[name]
        number = epoch - 1 - epochs.dropped
        return None if number <= 0 else epochs.taken()[number - 1].scene
