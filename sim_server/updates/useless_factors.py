# SPDX-License-Identifier: MIT
"""Factors that are no use are dropped: those that solves have to leave again and again.

A factor passes the guard (factor_check.py) by one vector and may be useless for what solves meet. A solve leaves such a
factor for block Jacobi by itself, but only after many iterations, so it must not be kept until another one comes.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.cpu.engine import Kind
from sim_server.updates.factor_source import FactorSource
from sim_server.updates.stats import Track

if TYPE_CHECKING:
    from sim_server.updates.policy import Driver

LEFT = 3  # solves in a row that left their factors, be they several: the one in use is dropped
POLICIES = ("async", "adaptive", "lockstep")  # with which another factor comes


class Finding(Enum):
    """What solves show of a factor."""

    OF_USE = auto()
    NO_USE = auto()


class Usefulness:
    """Of the factors of one body, one after another."""

    def __init__(self) -> None:
        self._made = -1  # step of the factor that solves were made with last
        self._left = 0  # solves in a row that left theirs
        self._told: Finding | None = None

    def observe(self, made: int, left: bool, used: bool) -> Finding | None:
        """A solve began with the factor of step `made` that left it, or used it to the end. What is found is told
        once."""
        if made != self._made:
            self._made, self._told = made, None
        if left:
            self._left += 1
        elif used:
            self._left = 0
        found = Finding.NO_USE if left and self._left >= LEFT else Finding.OF_USE if used and not left else self._told
        told, self._told = self._told, found
        return found if found is not told else None


class Dropping:
    """Of the bodies of one driver. source: whose workers are told what their factors were worth."""

    def __init__(self, driver: Driver, source: FactorSource):
        self._driver, self._source = driver, source
        self._active = driver.kind in POLICIES
        self._usefulness = [Usefulness() for _ in driver.tracks]
        self._doubted: set[int] = set()  # bodies whose solves have left a factor, or whose workers have sent bad ones

    def refused(self, factor: Factor) -> None:
        """A factor did not pass the guard."""
        self._doubted.add(self._driver.by_name[factor.object].body.index)
        self._source.factor_failed(factor.worker, factor.object)

    def judge(self, records: NDArray[Any]) -> None:
        """What the records say of factors. It costs nothing while no solve leaves one."""
        if not self._active or not (self._doubted or records["fallbacks"].any()):
            return
        for r in records:
            t, left, made = self._driver.tracks[r["body"]], bool(r["fallbacks"]), int(r["factor_step"])
            if made < 0 or not (left or t.body.index in self._doubted):
                continue
            self._doubted.add(t.body.index)
            found = self._usefulness[t.body.index].observe(made, left, r["kind"] == Kind.CHOLESKY)
            if found is Finding.NO_USE:
                self._drop(t, made)
            elif found is Finding.OF_USE:
                self._source.factor_helped(t.maker(made), t.body.name)
        for index in self._doubted:
            self.use_again(self._driver.tracks[index])

    def _drop(self, t: Track, made: int) -> None:
        """Solves go on with block Jacobi until another factor comes.

        A loop cannot be asked to give back a factor that it has taken up, so the kind of the solves is changed, which
        records, and so logs, hold of each.
        """
        worker, driver = t.maker(made), self._driver
        self._source.factor_failed(worker, t.body.name)
        if made != t.newest or t.dropped is not None:
            return
        settings = driver.engine.settings(t.body.index)
        t.drop(settings.kind, f"that of {worker} is not used any more: {LEFT} solves in a row had to leave theirs")
        if t.choice is None:
            settings.kind = Kind.BLOCK_JACOBI
        else:
            t.choice.factor_dropped()
            settings.kind, settings.probe = t.choice.kind, t.choice.probe
        driver.tell(t, t.refusal)

    def use_again(self, t: Track) -> None:
        """Solves use factors again once the loop has another one than that which was dropped."""
        if t.dropped is None or t.newest == t.dropped[0]:
            return
        made, kind = t.dropped
        engine = self._driver.engine
        if engine.exact or engine.factor_step(t.body.index) != made:
            t.dropped = None
            if t.choice is None:
                engine.settings(t.body.index).kind = kind
