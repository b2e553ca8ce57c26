# SPDX-License-Identifier: MIT
"""Factors that came in one message: checked beside the steps and given to the loop together, by columns.

What is done with each is what the driver does with a factor that came alone (driver.py), without a call of Python for
each where nothing special has to be done with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from protocol.factor import FactorPattern
from sim_server.arrays import Int64
from sim_server.backends.factors_together import FactorsTogether
from sim_server.updates.body_state import MadeFactors, on_checks, on_factors
from sim_server.updates.take_in import BegunCheck, TakenIn
from sim_server.updates.update_table import NONE

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

MANY = 8  # factors that came together, whose checks together take more than a few milliseconds


class ManyFactors:
    """Takes factors of messages for a driver whose steps wait for none."""

    def __init__(self, driver: Driver):
        self._driver = driver

    def begin_check(
        self, objects: Sequence[str], epochs: Sequence[int], patterns: Sequence[FactorPattern]
    ) -> BegunCheck | None:  # fmt: skip
        """Returns what factors that arrive are checked with; None: that must wait until they are adopted. From any
        thread; of a job that is over meanwhile another matrix may be written to the memory of its own, and what is
        found counts for nothing (`adopt`)."""
        bodies = self._driver.check.bodies(objects, epochs, patterns)
        return None if bodies is None else BegunCheck(bodies, self._driver.engine.response_function(), self._note)

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
        rows, steps = self._bodies(factors), np.array(factors.steps, np.int64)
        ready = (table.checked[rows] == NONE) & ~table.frozen[rows] & (steps > table.newest[rows])
        if factors.reasons is not None:  # by what was sent, as long as it is there
            ready &= table.matrix_steps[rows] == steps
        few = factors.reasons is None and np.count_nonzero(ready) < MANY
        if len(set(rows.tolist())) < len(factors) or few or driver.counted:
            return driver.adopt(list(factors))
        if not ready.all():
            driver.adopt(list(factors.of(np.flatnonzero(~ready).tolist())))
            factors = factors.of(np.flatnonzero(ready).tolist())
        if factors.reasons is None:
            self._check(factors)
            driver.policy.on_job_end()
        elif len(factors):
            driver.snapshots.release_all(self._bodies(factors))
            driver.take_up(factors, factors.reasons)

    def _check(self, factors: FactorsTogether) -> None:
        driver, rows = self._driver, self._bodies(factors).tolist()
        held = [driver.snapshots.hold(driver.bodies[row], step) for row, step in zip(rows, factors.steps, strict=True)]
        on_checks(driver.table, rows, factors.steps)
        memory, matrices = [copy for copy, _ in held], [matrix for _, matrix in held]
        driver.check_together(factors, memory, matrices)

    def take_up(self, factors: FactorsTogether, reasons: Sequence[str]) -> bool:
        """Gives the loop factors whose check has ended; False if any is not to be used, or is special."""
        driver, bodies = self._driver, self._bodies(factors)
        if any(reasons):
            return False
        epochs = list(map(driver.source.epoch, factors.objects))
        if epochs != factors.epochs and any(
            told not in (None, own) for told, own in zip(epochs, factors.epochs, strict=True)
        ):
            return False
        workers, regularized = [factors.worker] * len(factors), [bool(remedy) for remedy in factors.remedies]
        made = MadeFactors(factors.steps, factors.seconds, workers, regularized)
        newer = on_factors(driver.bodies, bodies, made, driver.engine.step)
        if not all(newer):
            for body, factor, better in zip(bodies.tolist(), factors, newer, strict=True):
                if not better:
                    driver.engine.drop_factor(body, factor)
            factors = factors.of([k for k, better in enumerate(newer) if better])
        if len(factors):
            self._post(factors)
        return True

    def _post(self, factors: FactorsTogether) -> None:
        driver, bodies = self._driver, self._bodies(factors).tolist()
        driver.engine.post_together(bodies, factors)
        if driver.on_adopt or driver.tuned or driver.table.dropped[bodies].any():
            for body, factor in zip(bodies, factors, strict=True):
                driver.tell(driver.bodies[body], factor)
