# SPDX-License-Identifier: MIT
"""Running means, and the cost of a factorization in operations."""

from typing import Any

import numpy as np

from protocol.factor import FactorPattern
from sim_server.backends.declarations import Declarations

MEMORY: float = Declarations("updates/update_table.cpp").constant("MEMORY")
"""Weight of the newest value in a running mean."""


def updated(mean: Any, value: Any) -> Any:
    """The exponential running mean after one more value; also of arrays."""
    return mean + MEMORY * (value - mean)


class RunningMean:
    """An exponential running mean; `value` is None before the first value."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: float | None = None

    def add(self, value: float) -> None:
        self.value = value if self.value is None else updated(self.value, value)

    def add_all(self, mean: float, rest: float, first: float) -> None:
        """Adds many values at once.

        mean: of these values with their weights
        rest: weight of the mean before them
        first: the first of them, which stands for the mean before if there is none
        """
        self.value = mean + rest * ((first if self.value is None else self.value) - mean)


def flops(pattern: FactorPattern) -> float:
    """Operations of a numeric Cholesky factorization: the sum of the squared column lengths of L."""
    width, height = np.diff(pattern.super_start).astype(float), np.diff(pattern.row_start).astype(float)
    low = height - width  # lengths of the columns of a supernode: low + 1 ... height
    return float((height * (height + 1) * (2 * height + 1) - low * (low + 1) * (2 * low + 1)).sum() / 6)
