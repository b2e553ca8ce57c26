# SPDX-License-Identifier: MIT
"""Factors that came in one message: checked beside the steps and given to the loop together, by columns.

What is done with each is what the driver does with a factor that came alone (driver.py), without a call of Python for
each where nothing special has to be done with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.factors_together import FactorsTogether
from sim_server.updates.body_state import BodyUpdateState, MadeFactors, on_checks, on_factors
from sim_server.updates.take_in import SentMatrices, TakenIn
from sim_server.updates.update_table import NONE

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

MANY = 8  # factors that came together, whose checks together take more than a few milliseconds


class ManyFactors:
    """Takes factors of messages for a driver whose steps wait for none."""

    def __init__(self, driver: Driver):
        self._driver = driver

    def begin_check(
        self, objects: Sequence[str], epochs: Sequence[int], patterns: Sequence[FactorPattern],
        matrices: Sequence[Float64],
    ) -> SentMatrices | None:  # fmt: skip
        """Returns what factors that arrive are checked with; None: that must wait until they are adopted. From any
        thread; of a job that is over meanwhile another matrix may be written to the memory of its own, and what is
        found counts for nothing (`_still_sent`)."""
        driver = self._driver
        bodies = driver.check.bodies(objects, epochs, patterns)
        if bodies is None:
            return None
        return SentMatrices(bodies, matrices, driver.engine.response_function(), self._note)

    def _still_sent(self, factors: FactorsTogether, rows: Sequence[int]) -> list[bool]:
        """Returns of which factors the matrix is still there that was sent. rows: their bodies"""
        sent = [self._driver.bodies[row].job.matrix for row in rows]
        return [own is not None and own[0] == step for own, step in zip(sent, factors.steps, strict=True)]

    def _note(self, factors: FactorsTogether, taken: TakenIn) -> None:
        """Takes note of what was found about factors that arrived, and has those that are good made ready for use."""
        factors.reasons = self._driver.reasons(len(factors), self._judged, factors, taken)

    def _judged(self, factors: FactorsTogether, taken: TakenIn) -> list[str]:
        driver = self._driver
        reasons = driver.check.reasons(factors, taken.found["judged"])
        factors.planes = driver.engine.planes_by(factors, taken.found["response"])
        good = factors if not any(reasons) else factors.of([k for k, why in enumerate(reasons) if not why])
        if len(good) >= MANY:
            driver.engine.prepare_together(self._bodies(good).tolist(), good)
        return reasons

    def _bodies(self, factors: FactorsTogether) -> Int64:
        """Returns the numbers of the bodies of factors."""
        if factors.bodies is None:
            by_name = self._driver.by_name
            factors.bodies = np.array([by_name[name].body.index for name in factors.objects], np.int64)
        return factors.bodies

    def adopt(self, factors: FactorsTogether) -> None:
        """Gives the loop factors that were checked, or begins to check them beside the caller. Few that were not, and
        those that wait for one before, are left to the driver one by one."""
        driver, table = self._driver, self._driver.table
        rows = np.array([driver.by_name[name].body.index for name in factors.objects])
        ready = (table.checked[rows] == NONE) & ~table.frozen[rows] & (factors.steps > table.newest[rows])
        if factors.reasons is not None:
            ready &= self._still_sent(factors, rows.tolist())
        few = factors.reasons is None and np.count_nonzero(ready) < MANY
        if len(set(factors.objects)) < len(factors) or few or driver.counted:
            return driver.adopt(list(factors))
        if not ready.all():
            driver.adopt(list(factors.of(np.flatnonzero(~ready).tolist())))
            chosen = np.flatnonzero(ready).tolist()
            factors, rows = factors.of(chosen), rows[chosen]
        if factors.reasons is None:
            self._check(factors, rows.tolist())
            driver.policy.on_job_end()
        elif factors.objects:
            for row, step in zip(rows.tolist(), factors.steps, strict=True):
                driver.snapshots.release(driver.bodies[row], step)
            driver.take_up(factors, factors.reasons)

    def _check(self, factors: FactorsTogether, rows: Sequence[int]) -> None:
        driver = self._driver
        held = [driver.snapshots.hold(driver.bodies[row], step) for row, step in zip(rows, factors.steps, strict=True)]
        on_checks(driver.table, rows, factors.steps)
        memory, matrices = [copy for copy, _ in held], [matrix for _, matrix in held]
        driver.check_together(factors, memory, matrices)

    def take_up(self, factors: FactorsTogether, reasons: Sequence[str]) -> bool:
        """Gives the loop factors whose check has ended; False if any is not to be used, or is special."""
        driver, epoch = self._driver, self._driver.source.epoch
        if any(reasons):
            return False
        if any(epoch(name) not in (None, own) for name, own in zip(factors.objects, factors.epochs, strict=True)):
            return False
        states = [driver.by_name[name] for name in factors.objects]
        workers, regularized = [factors.worker] * len(factors), [bool(remedy) for remedy in factors.remedies]
        made = MadeFactors(factors.steps, factors.seconds, workers, regularized)
        newer = on_factors(states, driver.table, made, driver.engine.step)
        if not all(newer):
            for state, factor, better in zip(states, factors, newer, strict=True):
                if not better:
                    driver.engine.drop_factor(state.body.index, factor)
            chosen = [k for k, better in enumerate(newer) if better]
            factors, states = factors.of(chosen), [states[k] for k in chosen]
        if states:
            self._post(factors, states)
        return True

    def _post(self, factors: FactorsTogether, states: Sequence[BodyUpdateState]) -> None:
        driver, bodies = self._driver, [state.body.index for state in states]
        driver.engine.post_together(bodies, factors)
        if driver.on_adopt or driver.tuned or driver.table.dropped[bodies].any():
            for state, factor in zip(states, factors, strict=True):
                driver.tell(state, factor)
