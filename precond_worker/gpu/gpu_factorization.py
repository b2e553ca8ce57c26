# SPDX-License-Identifier: MIT
"""Complete factorizations on the GPU."""

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int32
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.gpu.assembly_tree import assembly_tree
from precond_worker.gpu.device import best_precision, name, try_out
from precond_worker.gpu.executor import Executor
from precond_worker.gpu.plan import make_plan
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from protocol.factor import FactorPattern


class GpuFactorization:
    """Factors of one block pattern on the current CUDA device.

    precision: auto, float32 or float64. L in float64 is always computed in float64.
    """

    def __init__(self, row_start: Int32, columns: Int32, precision: str = "auto"):
        try_out(precision)
        self._precision = best_precision() if precision == "auto" else precision
        self.name = title(precision)
        tree = assembly_tree(eliminate(row_start, columns, order_nodes(row_start, columns)))
        self.pattern = FactorPattern.build(**tree.pattern_arrays())
        self.plan = make_plan(tree, row_start, columns)
        self._executors: dict[str, Executor] = {}

    def factorize(
        self, matrix: Float64, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Returns the values of L (factorize.Analysis.factorize). Raises MemoryError for lack of device memory."""
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

    def modified_ldl(
        self, matrix: Float64, dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """Raises NotPositiveDefinite: the fronts have no D."""
        raise NotPositiveDefinite("no LDL^T on a GPU")

    def executor(self, stored: str) -> Executor:
        """Returns the executor for values of L of this type, made at the first call."""
        if stored not in self._executors:
            precision = "float64" if stored == "float64" else self._precision
            self._executors[stored] = Executor(self.plan, precision, stored)
        return self._executors[stored]


def title(precision: str) -> str:
    """Returns device and precision in words; raises DeviceUnusable."""
    return f"{name()}, {best_precision() if precision == 'auto' else precision}"
