# SPDX-License-Identifier: MIT
"""Counters of the updates of all bodies, a column for each, so that a round of the service thread ranks and sums up a
thousand bodies in a few operations of NumPy. body_state.py reads and writes the row of one body.
"""

from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.updates.stats import updated

NONE = -1  # of a step: there is none


class UpdateTable:
    """A row for each body. Means are NaN while they are not known, steps NONE.

    excess, latest, lost, factor_step, max_factor_age, iteration_cost, first_excess: as in SolveStatistics
    refused, failures: as `refused`, `in_a_row` in FailureState
    newest, latency, cost, used: as in FactorStatistics; dropped: the newest factor is useless
    sent, in_flight, checked, excess_sent: as in JobState; copying: a copy is requested, or waits to be sent
    frozen, error_bound: as in BodyUpdateState
    """

    def __init__(self, bodies: int):
        def zeros() -> Float64:
            return np.zeros(bodies)

        def unknown() -> Float64:
            return np.full(bodies, np.nan)

        def steps() -> Int64:
            return np.full(bodies, NONE, np.int64)

        self.excess, self.latest, self.lost, self.excess_sent = zeros(), zeros(), zeros(), zeros()
        self.factor_step, self.max_factor_age, self.newest, self.sent = steps(), steps(), steps(), steps()
        self.checked = steps()
        self.iteration_cost, self.latency, self.cost = unknown(), unknown(), unknown()
        self.first_excess = unknown()
        self.refused, self.failures, self.used = (np.zeros(bodies, np.int64) for _ in range(3))
        self.error_bound = np.full(bodies, np.inf)
        self.dropped, self.in_flight, self.copying, self.frozen = (np.zeros(bodies, np.bool_) for _ in range(4))

    def __len__(self) -> int:
        return len(self.excess)


class Cell:
    """An attribute of a row object that stands in a column of the table: its `_table` and `_index` say where.

    column: empty: of the attribute's name
    """

    def __init__(self, column: str = ""):
        self._column = column

    def __set_name__(self, owner: type, name: str) -> None:
        self._column = self._column or name

    def __get__(self, row: Any, owner: type | None = None) -> Any:
        return getattr(row._table, self._column).item(row._index)

    def __set__(self, row: Any, value: Any) -> None:
        getattr(row._table, self._column)[row._index] = value


class MeanCell:
    """An exponential running mean in a column of the table; `value` is None before the first value."""

    __slots__ = ("_column", "_index")

    def __init__(self, column: Float64, index: int):
        self._column, self._index = column, index

    @property
    def value(self) -> float | None:
        """The mean."""
        mean = float(self._column[self._index])
        return None if mean != mean else mean

    def add(self, value: float) -> None:
        """Adds a value."""
        mean = self._column[self._index]
        self._column[self._index] = value if mean != mean else updated(float(mean), value)
