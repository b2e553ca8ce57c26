# SPDX-License-Identifier: MIT
"""What a server loses to old and missing factors, so that workers of a pool go where they help most."""

import time
from collections.abc import Callable
from math import exp

from sim_server.backends.kinds import Kind
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.driver import Driver

PERIOD = 0.5  # s between two looks
MEMORY = 2.0  # s over which it is averaged: the excess of a body grows with the age of its factor
BYTES = 1e10  # that a core moves in a second, where the costs of a run are counted in bytes


class NeedMeter:
    """Measures the time that solves lose. lost: s of solving a second that old or missing factors cost"""

    def __init__(self, driver: Driver, clock: Callable[[], float] = time.monotonic):
        self._driver, self._clock = driver, clock
        self.lost = 0.0
        self._looked, self._step = clock(), driver.engine.step

    def look(self) -> bool:
        """Measures anew if it is time to; returns True then."""
        now = self._clock()
        since = now - self._looked
        if since < PERIOD:
            return False
        step = self._driver.engine.step
        rate = max(step - self._step, 0) / since  # of steps; a reset goes back
        self._looked, self._step = now, step
        lost = rate * sum(map(self._of_a_step, self._driver.bodies)) if self._driver.wants_factors else 0.0
        self.lost += (1 - exp(-since / MEMORY)) * (lost - self.lost)
        return True

    def _of_a_step(self, state: BodyUpdateState) -> float:
        """Returns what the last solve of a body lost [s]. A body that does better without factors loses nothing, and
        one whose jobs fail is not where workers help."""
        tuner, solves = state.tuner, state.solves
        without = tuner is not None and Kind(tuner.kind) is not Kind.CHOLESKY and not tuner.wants_factor
        if state.frozen or without or solves.iteration_cost.value is None:
            return 0.0
        cost = solves.iteration_cost.value / (BYTES if state.counted else 1.0)
        return float(solves.latest * cost / 2 ** min(state.failures.in_a_row, 30))
