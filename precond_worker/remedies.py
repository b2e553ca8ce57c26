# SPDX-License-Identifier: MIT
"""Complete factors also of matrices that are not positive definite, or singular but for rounding.

1. L |D| L^T: an LDL^T factorization with its negative pivots turned positive (Gill, Murray and Wright, Practical
   Optimization, 1981, section 4.4.2.2). Exact but for a space of as many dimensions as pivots were turned.
2. Where pivots are noise, as of a body that nothing holds at a huge time step, or that grows out of hand: Cholesky of A
   with its diagonal shifted.
"""

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.blocks import BLOCK, checked_pattern, node_norms, noise, rows_of
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.factorize import Analysis
from protocol import FactorPattern

FINER = 10  # a shift is so many times the noise, of each node's norm, and so many times as large each time
GROWTH = 1e8  # of |L| |D| |L^T| over A, beyond which rounding has eaten half of the digits


class Cholesky:
    """factorize.Analysis with remedies. remedy: of the last factor, in a few words; empty: none was needed."""

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, library: str = "auto"):
        """Arguments and errors: factorize.Analysis."""
        self._analysis = Analysis(row_start, columns, library)
        start, column = checked_pattern(row_start, columns)
        self._row_start = start
        self._diagonal = np.flatnonzero(rows_of(start) == column)
        self.remedy = ""

    @property
    def pattern(self) -> FactorPattern:
        """The same for every matrix."""
        return self._analysis.pattern

    @property
    def library(self) -> str:
        """Name and version."""
        return self._analysis.library

    def factorize(self, values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[np.floating]:
        """Values of L as Analysis.factorize. Raises NotPositiveDefinite only where no remedy helps."""
        self.remedy = ""
        matrix = np.ascontiguousarray(values, np.float64)
        try:
            made = self._analysis.factorize(matrix, dtype)
            shifted = None if self._sound(made, matrix) else self._shifted(matrix, dtype)
            return made if shifted is None else shifted
        except OutOfRange:
            raise
        except NotPositiveDefinite as first:
            found = self._turned(matrix, dtype)
            found = self._shifted(matrix, dtype) if found is None else found
            if found is None:
                raise first
            return found

    def _sound(self, made: NDArray[np.floating], matrix: NDArray[np.float64]) -> bool:
        """Whether every pivot is more than noise."""
        pivots = made[self.pattern.diagonal].astype(np.float64) ** 2
        diagonal = np.abs(np.diagonal(matrix[self._diagonal], axis1=1, axis2=2)).max(axis=1)
        return bool((pivots > noise(made.dtype) * diagonal[self.pattern.permutation // BLOCK]).all())

    def _turned(self, matrix: NDArray[np.float64], dtype: DTypeLike) -> NDArray[np.floating] | None:
        try:
            made, turned = self._analysis.turned(matrix, dtype, GROWTH)
        except NotPositiveDefinite:
            return None
        self.remedy = f"{turned} pivot{'s' if turned != 1 else ''} of LDL^T turned positive"
        return made

    def _shifted(self, matrix: NDArray[np.float64], dtype: DTypeLike) -> NDArray[np.floating] | None:
        shift = noise(dtype)
        norm = node_norms(self._row_start, matrix)
        while (shift := FINER * shift) < 2:
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
