# SPDX-License-Identifier: MIT
"""Complete factorizations on the GPU."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int32, Int64
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.gpu.assembly_tree import assembly_tree
from precond_worker.gpu.copies import copies
from precond_worker.gpu.device import best_precision, cupy, name, try_out
from precond_worker.gpu.executor import Executor
from precond_worker.gpu.plan import MultifrontalPlan, make_plan
from precond_worker.many import Begun, GivenMatrices, Made, Matrices
from precond_worker.symbolic.blocks import BLOCK, rows_of
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from precond_worker.symbolic.pivots import PivotCheck
from protocol.factor import FactorPattern

MOST = 64  # matrices that are factorized together
COPIES = (1, 4, 16, MOST)  # of a pattern in the plans that are made
AT_A_TIME = 2  # factors of a matrix alone: one is being sent while the next one is made
BYTES = 64 << 20  # of the matrices and factors of a launch, about


class GpuFactorization:
    """Factors of one block pattern on the current CUDA device.

    precision: auto, float32 or float64. L in float64 is always computed in float64.
    most: matrices that `begin_many` takes at a time; they take hardly more time than one
    """

    def __init__(self, row_start: Int32, columns: Int32, precision: str = "auto"):
        try_out(precision)
        self._precision = best_precision() if precision == "auto" else precision
        self.name = title(precision)
        tree = assembly_tree(eliminate(row_start, columns, order_nodes(row_start, columns)))
        self.pattern = FactorPattern.build(**tree.pattern_arrays())
        self.plan = make_plan(tree, row_start, columns)
        self._tree, self._row_start, self._columns = tree, row_start, columns
        self._places: tuple[Any, Any] | None = None  # of what shows whether pivots are sound, on the device
        self._executors: dict[tuple[str, int], list[Executor]] = {}
        bytes_of_one = 8 * self.pattern.nonzeros + 72 * len(columns)
        self.most = max(1, min(MOST, BYTES // bytes_of_one))
        self._check = PivotCheck(self.pattern, np.flatnonzero(rows_of(row_start) == columns))

    def factorize(
        self, matrix: Float64, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Returns the values of L (factorize.Analysis.factorize). Raises MemoryError for lack of device memory."""
        found, outcome = self.executor(dtype.name).run(GivenMatrices([matrix]))
        values: NDArray[np.floating] = found[0]
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

    def factorize_on_device(
        self, matrix: int, dtype: np.dtype[np.floating], diagonal_blocks: Int64, threshold: float
    ) -> Callable[[int], None] | None:
        """Factorizes a matrix on the device; returns what copies L to an address there. None: it has no factor, or may
        need a remedy.

        matrix: address of the values (blocks, 3, 3)
        diagonal_blocks: place of the diagonal block of each node
        threshold: least square of a pivot, over the largest diagonal entry of its node
        """
        executor = self.executor(dtype.name)
        outcome = executor.run_on_device(matrix)
        if outcome.infinite or outcome.pivot >= 0 or outcome.range >= 0:
            return None
        if self._places is None:
            cp, nodes = cupy(), self.pattern.permutation // BLOCK
            blocks = diagonal_blocks[nodes].astype(np.int32)
            self._places = cp.asarray(self.pattern.diagonal.astype(np.int64)), cp.asarray(blocks)
            cp.cuda.get_current_stream().synchronize()
        sound = executor.pivots_are_sound(*self._places, threshold)
        return executor.copy_values if sound else None

    def make_ready(self, dtype: np.dtype[Any]) -> None:
        """Takes memory, makes the launches for matrices one by one, and tries them with zeros: the device then has all
        that it loads at first use, and page-locked memory is there for as many L as are at a time."""
        executor, zeros = self.executor(dtype.name), np.zeros((self.plan.blocks, 3, 3))
        together = [executor.run(GivenMatrices([zeros])) for _ in range(AT_A_TIME)]
        del together

    @property
    def together(self) -> int:
        """Number of matrices that take hardly more time than one."""
        return self.most

    def begin_many(self, matrices: Matrices, dtype: np.dtype[np.floating]) -> Begun | None:
        """Begins to factorize up to `most` matrices in the launches of one; None if the device has too little memory.
        If one of them has no factor, none is good.

        Two such may be under way.
        """
        try:
            executor = self.executor(dtype.name, next(c for c in COPIES if c >= len(matrices)))
            run = executor.begin(matrices)
        except MemoryError:
            self.most = 1
            return None
        scales = self._check.scales(executor.sent[: len(matrices)])  # while the device is at work

        def end() -> Made:
            values, outcome = run()
            if outcome.infinite or outcome.pivot >= 0 or outcome.range >= 0:
                return Made(values, np.zeros(len(values), np.bool_))
            return Made(values, self._check.sound(values, scales))

        return Begun(end, beside=True)

    def modified_ldl(
        self, matrix: Float64, dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """Raises NotPositiveDefinite: the fronts have no D."""
        raise NotPositiveDefinite("no LDL^T on a GPU")

    def executor(self, stored: str, count: int = 1) -> Executor:
        """Returns an executor for values of L of this type, of `count` matrices at a time; made at the first call. Of
        many there are two, in turn: one may still be at work."""
        known = self._executors.setdefault((stored, count), [])
        if len(known) < (2 if count > 1 else 1):
            precision = "float64" if stored == "float64" else self._precision
            plan = known[0].plan if known else self._plan_of(count)
            known.append(Executor(plan, precision, stored, count))
        else:
            known.append(known.pop(0))
        return known[-1]

    def _plan_of(self, count: int) -> MultifrontalPlan:
        if count == 1:
            return self.plan
        many = copies(self._tree, self._row_start, self._columns, count)
        return make_plan(many.tree, many.row_start, many.columns)


def title(precision: str) -> str:
    """Returns device and precision in words; raises DeviceUnusable."""
    return f"{name()}, {best_precision() if precision == 'auto' else precision}"
