# SPDX-License-Identifier: MIT
"""Incomplete factors: Cholesky with a drop tolerance, and SSOR."""

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.arrays import Float64
from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization.block_columns import BlockColumns, banded_order
from precond_worker.symbolic.blocks import BLOCK, checked_pattern, pivot_threshold
from protocol.factor import FactorPattern
from protocol.method import Method

FIRST_SHIFT = 1e-4  # over the norm of a node; each shift is three times the one before
MAX_SHIFTS = 15


class SparseFactorization:
    """Base of the sparse factorizations.

    pattern: of the last factor. It changes with the dropped blocks, but depends on the values alone, so that runs
    repeat and workers agree.
    """

    library = "native"

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, method: Method):
        """row_start, columns: as of factorize.Analysis. Raises ValueError if the pattern is none."""
        start, column = checked_pattern(row_start, columns)
        self._blocks, self._method = len(column), method
        natural = np.arange(len(start) - 1)  # the factor of SSOR depends on the order: that of the nodes
        self._native = BlockColumns(start, column, natural if method.name == "ssor" else banded_order(start, column))
        self.remedy = ""

    @property
    def pattern(self) -> FactorPattern:
        """Pattern of the last factor."""
        assert self._native.pattern is not None
        return self._native.pattern

    def factorize(self, values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[np.floating]:
        """Returns the values of L in the order of the pattern, float32 or float64, computed in float64.

        values: float64 (blocks, 3, 3). Raises ValueError for values of another shape or not finite,
        NotPositiveDefinite.
        """
        matrix = np.ascontiguousarray(values, np.float64)
        if matrix.shape != (self._blocks, BLOCK, BLOCK):
            raise ValueError(f"matrix: values of shape {matrix.shape}, allowed: ({self._blocks}, {BLOCK}, {BLOCK})")
        if not np.isfinite(matrix).all():
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        self._make(matrix, pivot_threshold(dtype))
        with np.errstate(over="ignore", under="ignore"):
            factor = self._native.values().astype(dtype)
        pivots = factor[self.pattern.diagonal]
        if not (np.isfinite(factor).all() and (pivots >= np.finfo(factor.dtype).tiny).all()):
            raise NotPositiveDefinite(f"matrix: incomplete factor out of the range of {factor.dtype}")
        return factor

    def _make(self, matrix: Float64, pivot_threshold: float) -> None:
        raise NotImplementedError


class IncompleteCholesky(SparseFactorization):
    """Incomplete Cholesky; where a pivot is not positive, it is repeated with a shifted diagonal (Manteuffel 1980)."""

    def _make(self, matrix: Float64, pivot_threshold: float) -> None:
        shift, node = 0.0, -1
        for shift in (0.0, *(FIRST_SHIFT * 3.0**k for k in range(MAX_SHIFTS))):
            node = self._native.incomplete(
                matrix, shift, self._method.drop_tolerance, self._method.fill, pivot_threshold
            )
            if node < 0:
                self.remedy = f"diagonal shifted by {shift:g}" if shift else ""
                return
        raise NotPositiveDefinite(f"matrix: no incomplete factor, diagonal shifted by up to {shift:g} (node {node})")


class Ssor(SparseFactorization):
    """P = (D/w + L) (D/w)^-1 (D/w + L)^T w / (2 - w) with A = L + D + L^T in blocks (Saad, 2nd edition, 10.2)."""

    def _make(self, matrix: Float64, pivot_threshold: float) -> None:
        if (node := self._native.ssor(matrix, self._method.omega)) >= 0:
            raise NotPositiveDefinite(f"matrix: diagonal block of node {node} is not positive definite")
