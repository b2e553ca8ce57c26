# SPDX-License-Identifier: MIT
"""Drops factors that are useless: those that solves abandon again and again.

A factor passes the check (factor_check.py) by one vector and may be useless for what solves meet. A solve abandons such
a factor for block Jacobi by itself, but only after many iterations, so it must not be kept until another one comes.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.base import Capability
from sim_server.backends.kinds import Kind
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.update_table import ABANDONED

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

MAX_FALLBACKS = 3  # solves in a row that abandoned their factors, be they several: the one in use is dropped


class Verdict(Enum):
    """Verdict of solves on a factor."""

    USEFUL = auto()
    USELESS = auto()


class FallbackCounter:
    """Counts solves of one body that abandoned their factors, which come one after another."""

    def __init__(self) -> None:
        self._factor_step = -1  # of the factor that the last solve had
        self._fallbacks = 0  # in a row
        self._verdict: Verdict | None = None  # on that factor

    def observe(self, factor_step: int, abandoned: bool, used: bool) -> Verdict | None:
        """Returns the verdict on a factor, once; None if there is none, or no other one than before.

        factor_step: of the factor with which a solve began
        abandoned, used: the solve abandoned it, used it to the end
        """
        if factor_step != self._factor_step:
            self._factor_step, self._verdict = factor_step, None
        if abandoned:
            self._fallbacks += 1
        elif used:
            self._fallbacks = 0
        before = self._verdict
        if abandoned and self._fallbacks >= MAX_FALLBACKS:
            self._verdict = Verdict.USELESS
        elif used and not abandoned:
            self._verdict = Verdict.USEFUL
        return self._verdict if self._verdict is not before else None


class UselessFactors:
    """Drops the useless factors of the bodies of one driver, and tells their source what factors were worth."""

    def __init__(self, driver: Driver):
        self._driver, self._source = driver, driver.source
        self._counters = [FallbackCounter() for _ in driver.bodies]
        self._suspects: set[int] = set()  # bodies of which a factor was abandoned or rejected

    def on_rejected(self, factor: Factor) -> None:
        """Takes note that a factor did not pass the check."""
        self._suspects.add(self._driver.by_name[factor.object].body.index)
        self._source.factor_failed(factor.worker, factor.object, factor.pattern.id)

    def observe(self, records: NDArray[Any], told: int) -> None:
        """Takes note of solves. It costs nothing while none of them abandons its factor. told: what the records tell
        (update_table.told)"""
        if not self._driver.policy.renews or not (self._suspects or told & ABANDONED):
            return
        abandoned = records["fallbacks"] > 0
        suspected = np.zeros(len(self._counters), np.bool_)
        suspected[list(self._suspects)] = True
        suspected[records["body"][abandoned]] = True
        for r in records[suspected[records["body"]]]:
            state, left, step = self._driver.bodies[r["body"]], bool(r["fallbacks"]), int(r["factor_step"])
            index = state.body.index
            if step < 0 or not (left or index in self._suspects):
                continue
            self._suspects.add(index)
            verdict = self._counters[index].observe(step, left, r["kind"] == Kind.CHOLESKY)
            if verdict is Verdict.USELESS:
                self._found_useless(state, step)
            elif verdict is Verdict.USEFUL:
                self._source.factor_helped(state.factors.worker(step), state.body.name)
        for index in self._suspects:
            self.resume(self._driver.bodies[index])

    def _found_useless(self, state: BodyUpdateState, step: int) -> None:
        self._source.factor_failed(state.factors.worker(step), state.body.name)
        if step == state.factors.newest and state.factors.dropped is None:
            self.drop(state)

    def drop(self, state: BodyUpdateState) -> None:
        """Lets solves go on with block Jacobi until another factor comes.

        A loop cannot be asked to give back a factor that it has taken up, so the kind of the solves is changed, which
        records, and so logs, hold of each.
        """
        driver, worker = self._driver, state.factors.worker(state.factors.newest)
        settings = driver.engine.settings(state.body.index)
        reason = f"that of {worker} is not used any more: {MAX_FALLBACKS} solves in a row had to leave theirs"
        state.on_drop(settings.kind, reason)
        if state.tuner is None:
            settings.kind = Kind.BLOCK_JACOBI
        else:
            state.tuner.on_drop()
            driver.apply_choice(state)
        driver.report(state, reason)

    def resume(self, state: BodyUpdateState) -> None:
        """Lets solves use factors again once the loop has another one than that which was dropped."""
        dropped = state.factors.dropped
        if dropped is None or state.factors.newest == dropped[0]:
            return
        step, kind = dropped
        engine = self._driver.engine
        if Capability.EXACT_STEPS in engine.capabilities or engine.factor_step(state.body.index) != step:
            state.factors.dropped = None
            if state.tuner is None:
                engine.settings(state.body.index).kind = kind
