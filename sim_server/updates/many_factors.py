# SPDX-License-Identifier: MIT
"""Factors that came in one message: checked beside the steps and given to the loop together, by columns.

What is done with each is what the driver does with a factor that came alone (driver.py), without a call of Python for
each where nothing special has to be done with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from protocol.factors_together import FactorsTogether
from sim_server.updates.body_state import BodyUpdateState, MadeFactors, on_checks, on_factors
from sim_server.updates.update_table import NONE

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver, FactorsUnderCheck

MANY = 8  # factors that came together, whose checks together take more than a few milliseconds


class ManyFactors:
    """Takes factors of messages for a driver whose steps wait for none."""

    def __init__(self, driver: Driver):
        self._driver = driver

    def adopt(self, factors: FactorsTogether) -> None:
        """Begins to check factors beside the caller; those that are few, or wait for one before, are left to the driver
        one by one."""
        driver, table = self._driver, self._driver.table
        rows = np.array([driver.by_name[name].body.index for name in factors.objects])
        ready = (table.checked[rows] == NONE) & ~table.frozen[rows] & (factors.steps > table.newest[rows])
        if len(set(factors.objects)) < len(factors) or np.count_nonzero(ready) < MANY or driver.counted:
            return driver.adopt(list(factors))
        if not ready.all():
            driver.adopt(list(factors.of(np.flatnonzero(~ready).tolist())))
            chosen = np.flatnonzero(ready).tolist()
            factors, rows = factors.of(chosen), rows[chosen]
        self._check(factors, rows.tolist())
        driver.policy.on_job_end()

    def _check(self, factors: FactorsTogether, rows: Sequence[int]) -> None:
        driver = self._driver
        held = [driver.snapshots.hold(driver.bodies[row], step) for row, step in zip(rows, factors.steps, strict=True)]
        on_checks(driver.table, rows, factors.steps)
        memory, matrices = [copy for copy, _ in held], [matrix for _, matrix in held]
        driver.check_together(factors, memory, matrices)

    def take_up(self, check: FactorsUnderCheck) -> bool:
        """Gives the loop the factors of a check that has ended; False if any is not to be used, or is special."""
        factors, driver = check.factors, self._driver
        if not isinstance(factors, FactorsTogether) or any(check.reasons.result()):
            return False
        epoch = driver.source.epoch
        if any(epoch(name) not in (None, own) for name, own in zip(factors.objects, factors.epochs, strict=True)):
            return False
        states = [driver.by_name[name] for name in factors.objects]
        workers, regularized = [factors.worker] * len(factors), [bool(remedy) for remedy in factors.remedies]
        made = MadeFactors(factors.steps, factors.seconds, workers, regularized)
        newer = on_factors(states, driver.table, made, driver.engine.step)
        if not all(newer):
            chosen = [k for k, better in enumerate(newer) if better]
            factors, states = factors.of(chosen), [states[k] for k in chosen]
        if states:
            self._post(factors, states)
        driver.policy.on_job_end()
        return True

    def _post(self, factors: FactorsTogether, states: Sequence[BodyUpdateState]) -> None:
        driver, bodies = self._driver, [state.body.index for state in states]
        driver.engine.post_together(bodies, factors)
        if driver.on_adopt or driver.tuned or driver.table.dropped[bodies].any():
            for state, factor in zip(states, factors, strict=True):
                driver.tell(state, factor)
