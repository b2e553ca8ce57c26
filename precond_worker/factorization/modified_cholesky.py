# SPDX-License-Identifier: MIT
"""Complete factors, also of matrices that are indefinite or numerically singular.

1. L |D| L^T: an LDL^T factorization with the signs of negative pivots flipped (Gill, Murray and Wright, Practical
   Optimization, 1981, section 4.4.2.2). It equals A but for a space of as many dimensions as there are negative pivots.
2. Cholesky of A with a shifted diagonal, where pivots are rounding error (as of a free body at a huge time step) or the
   growth of LDL^T is out of bounds.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.arrays import Float64
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.factorization.factorize import Analysis
from precond_worker.many import Begun, Matrices
from precond_worker.symbolic.blocks import checked_pattern, node_norms, pivot_threshold, rows_of
from precond_worker.symbolic.pivots import PivotCheck
from protocol.factor import FactorPattern

SHIFT_FACTOR = 10  # of each shift over the one before; the first is relative to blocks.pivot_threshold
GROWTH = 1e8  # bound of |L| |D| |L^T| over A, beyond which half of the digits are lost


class ModifiedCholesky:
    """factorize.Analysis with remedies. remedy: of the last factor, in a few words; empty if none was needed."""

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, library: str = "auto"):
        """Arguments and errors: factorize.Analysis."""
        self._analysis = Analysis(row_start, columns, library)
        start, column = checked_pattern(row_start, columns)
        self._row_start = start
        self._diagonal = np.flatnonzero(rows_of(start) == column)
        self._check = PivotCheck(self.pattern, self._diagonal)
        self.remedy = ""

    @property
    def pattern(self) -> FactorPattern:
        """Pattern of L, the same for every matrix."""
        return self._analysis.pattern

    @property
    def library(self) -> str:
        """Name and version."""
        return self._analysis.library

    def factorize(self, values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[np.floating]:
        """Returns the values of L as Analysis.factorize. Raises NotPositiveDefinite only where no remedy helps."""
        self.remedy = ""
        matrix = np.ascontiguousarray(values, np.float64)
        try:
            made = self._analysis.factorize(matrix, dtype)
            shifted = None if self._sound(made, matrix) else self._shifted(matrix, dtype)
            return made if shifted is None else shifted
        except OutOfRange:
            raise
        except NotPositiveDefinite as first:
            found = self._modified_ldl(matrix, dtype)
            found = self._shifted(matrix, dtype) if found is None else found
            if found is None:
                raise first
            return found

    def factorize_on_device(self, matrix: int, dtype: DTypeLike) -> Callable[[int], None] | None:
        """Factorizes a matrix at an address of device memory; returns what copies the L of `factorize` to one. None: it
        may need a remedy, or the library is of the host."""
        self.remedy = ""
        return self._analysis.factorize_on_device(matrix, dtype, self._diagonal, pivot_threshold(dtype))

    def make_ready(self) -> None:
        """Does before the first matrix what it would wait for. Raises MemoryError, DeviceUnusable."""
        self._analysis.make_ready()

    @property
    def most(self) -> int:
        """Number of matrices that are factorized together."""
        return self._analysis.most

    @property
    def together(self) -> int:
        """Number of matrices that take hardly more time than one, factorized together."""
        return self._analysis.together

    def begin_many(self, matrices: Matrices, dtype: DTypeLike = np.float32) -> Begun | None:
        """Begins to factorize up to `most` matrices together, as Analysis.begin_many."""
        self.remedy = ""
        return self._analysis.begin_many(matrices, dtype)

    def _sound(self, made: NDArray[np.floating], matrix: Float64) -> bool:
        """True if every pivot of a factor, and its matrix, is more than rounding error."""
        return bool(self._check.sound(made[None], self._check.scales(matrix.reshape(1, -1)))[0])

    def _modified_ldl(self, matrix: Float64, dtype: DTypeLike) -> NDArray[np.floating] | None:
        try:
            made, flipped = self._analysis.modified_ldl(matrix, dtype, GROWTH)
        except NotPositiveDefinite:
            return None
        self.remedy = f"{flipped} pivot{'s' if flipped != 1 else ''} of LDL^T turned positive"
        return made

    def _shifted(self, matrix: Float64, dtype: DTypeLike) -> NDArray[np.floating] | None:
        shift = pivot_threshold(dtype)
        norm = node_norms(self._row_start, matrix)
        while (shift := SHIFT_FACTOR * shift) < 2:
            more = matrix.copy()
            more[self._diagonal] += shift * norm[:, None, None] * np.eye(3)
            try:
                made = self._analysis.factorize(more, dtype)
            except NotPositiveDefinite:
                continue
            if self._sound(made, more):
                self.remedy = f"diagonal shifted by {shift:g}"
                return made
        return None
