# SPDX-License-Identifier: MIT
"""The GPU as one of the libraries of precond_worker.factorize."""

import numpy as np
from numpy.typing import NDArray

from precond_worker.blocks import Index
from precond_worker.elimination import eliminate
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.gpu.assembly_tree import assembly_tree
from precond_worker.gpu.device import best_arithmetic, name, try_out
from precond_worker.gpu.executor import Executor
from precond_worker.gpu.plan import make_plan
from precond_worker.ordering import order_nodes
from protocol import FactorPattern


class Gpu:
    """Factors of one block pattern on the current CUDA device.

    arithmetic: auto, float32 or float64. L in float64 is always computed in float64.
    """

    def __init__(self, row_start: Index, columns: Index, arithmetic: str = "auto"):
        try_out(arithmetic)
        self._arithmetic = best_arithmetic() if arithmetic == "auto" else arithmetic
        self.name = title(arithmetic)
        tree = assembly_tree(eliminate(row_start, columns, order_nodes(row_start, columns)))
        self.pattern = FactorPattern.build(**tree.pattern_arrays())
        self.plan = make_plan(tree, row_start, columns)
        self._executors: dict[str, Executor] = {}

    def factorize(
        self, matrix: NDArray[np.float64], dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Values of L (factorize.Analysis.factorize). Raises MemoryError if the device has too little memory left."""
        values, outcome = self.executor(dtype.name).run(matrix)
        if outcome.infinite:
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        if outcome.pivot >= 0:
            raise NotPositiveDefinite("pivot not positive", outcome.pivot)
        if outcome.range >= 0:
            raise OutOfRange(f"factor out of the range of {dtype}", outcome.range)
        if out is None:
            return values
        np.copyto(out, values)
        return out

    def turned(
        self, matrix: NDArray[np.float64], dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """None here: the fronts know no D. Raises NotPositiveDefinite."""
        raise NotPositiveDefinite("no LDL^T on a GPU")

    def executor(self, stored: str) -> Executor:
        """For L in this type, made when it is first wanted."""
        if stored not in self._executors:
            arithmetic = "float64" if stored == "float64" else self._arithmetic
            self._executors[stored] = Executor(self.plan, arithmetic, stored)
        return self._executors[stored]


def title(arithmetic: str) -> str:
    """Device and arithmetic in words; raises DeviceUnusable."""
    return f"{name()}, {best_arithmetic() if arithmetic == 'auto' else arithmetic}"
