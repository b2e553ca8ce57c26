# SPDX-License-Identifier: MIT
"""What the records of solves tell: the excess of each body for the scheduler, and costs for `auto`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol.messages_pb2 import RUNAWAY
from sim_server.backends.kinds import Kind
from sim_server.updates.autotune.convergence import Convergence, convergence
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.update_table import RAN_AWAY, told

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

MIN_TOGETHER = 8  # records from which on whole steps are summed up together
BLOCK_BYTES = 72.0  # of a 3x3 block of A


class SolveObserver:
    """Sums up the records of one driver's solves."""

    def __init__(self, driver: Driver):
        self._driver = driver
        simulation = driver.simulation
        system, bodies = simulation.system, simulation.world.bodies
        self._tuned = any(state.tuner is not None for state in driver.bodies)
        self._position = np.array([simulation.engine.settings(b.index).position for b in bodies])
        self._matrix_bytes = [BLOCK_BYTES * len(system.body_values(b.first, b.last)) for b in bodies]

    def observe(self, records: NDArray[Any]) -> int:
        """Sums up contiguous records of the loop, in their order. Returns what they tell (update_table.told)."""
        states = self._driver.bodies
        whole_steps = len(records) >= max(len(states), MIN_TOGETHER) and len(records) % len(states) == 0
        if whole_steps and not self._driver.counted:
            tells = self._observe_steps(records.reshape(-1, len(states)))
        else:
            self._observe_each(records)
            tells = told(records)
        if tells & RAN_AWAY and self._driver.simulation.energies.freezes:
            for body in set(records["body"][records["status"] == RUNAWAY].tolist()):
                states[body].frozen = True
        return tells

    def _observe_each(self, records: NDArray[Any]) -> None:
        driver, solver = self._driver, self._driver.solver
        for r in records:
            state, kind = driver.bodies[r["body"]], Kind(r["kind"])
            iterations, step = int(r["iterations"]), int(r["factor_step"])
            cost = self._bytes_moved(state, kind, iterations) if driver.counted else float(r["solve"])
            state.observe(r, solver.update_floor_iterations, cost)
            if state.tuner is None:
                continue
            method, solves = state.factors.method(step), max(int(r["linearizations"]), 1)
            waiting = driver.policy.waiting_cost(state.factors.method_cost(method)) if method else 0.0
            shortfall, used = convergence(r, solver, self._position[state.body.index])
            state.tuner.observe(
                kind, iterations / solves, cost / solves, Kind(r["asked"]), (method, step), waiting,
                Convergence(float(shortfall), float(used)), int(r["fallbacks"]),
            )  # fmt: skip
            driver.apply_choice(state)

    def _observe_steps(self, r: NDArray[Any]) -> int:
        """Sums up whole steps, (steps, bodies): where bodies are many, their factors wait for this function. Returns
        what they tell."""
        driver, states = self._driver, self._driver.bodies
        tells = driver.table.observe(r, driver.solver.update_floor_iterations)
        if not self._tuned:
            return tells
        shortfall, used = convergence(r, driver.solver, self._position)
        solves = np.maximum(r["linearizations"], 1)
        begun = (r["kind"], r["iterations"] / solves, r["solve"] / solves, r["asked"])
        ended = (shortfall, used, r["fallbacks"], r["factor_step"])
        columns = (column.T.tolist() for column in (*begun, *ended))
        for state, *rows, factor_steps in zip(states, *columns, strict=True):
            if state.tuner is not None:
                state.tuner.observe_steps(*rows, [(state.factors.method(step), step) for step in factor_steps])
                driver.apply_choice(state)
        return tells

    def _bytes_moved(self, state: BodyUpdateState, kind: Kind, iterations: int) -> float:
        """Returns the bytes that a solve moved, about: the deterministic stand-in for its time."""
        matrix = self._matrix_bytes[state.body.index]
        other = matrix if kind is Kind.SSOR else 0.0
        if kind is Kind.CHOLESKY:
            other = 2.0 * self._driver.engine.factor_bytes(state.body.index)
        return (iterations + 1) * (matrix + other)
