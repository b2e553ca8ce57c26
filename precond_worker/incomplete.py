# SPDX-License-Identifier: MIT
"""Incomplete factors: Cholesky with a drop tolerance, and SSOR of the matrix sent."""

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.block_columns import BlockColumns, banded_order
from precond_worker.blocks import BLOCK, checked_pattern, noise
from precond_worker.errors import NotPositiveDefinite
from protocol import FactorPattern
from protocol.method import Method

FIRST_SHIFT = 1e-4  # of each node's norm, three times as much each time ...
SHIFTS = 15  # ... at most so often


class Sparse:
    """What both have in common.

    pattern: of the factor made last. It is a function of the values alone, so that runs repeat and workers agree; what
    is dropped changes with the matrix, and with it the pattern.
    """

    library = "native"

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, method: Method):
        """row_start, columns: as of factorize.Analysis. Raises ValueError if the pattern is none."""
        start, column = checked_pattern(row_start, columns)
        self._blocks, self._method = len(column), method
        natural = np.arange(len(start) - 1)  # of SSOR the order decides the value: it keeps that of the nodes
        self._native = BlockColumns(start, column, natural if method.name == "ssor" else banded_order(start, column))
        self.remedy = ""

    @property
    def pattern(self) -> FactorPattern:
        """Of the factor made last."""
        assert self._native.pattern is not None
        return self._native.pattern

    def factorize(self, values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[np.floating]:
        """Values of L in the order of the pattern, float32 or float64, computed in float64.

        values: float64 (blocks, 3, 3). Raises ValueError for values of another shape or not finite,
        NotPositiveDefinite.
        """
        matrix = np.ascontiguousarray(values, np.float64)
        if matrix.shape != (self._blocks, BLOCK, BLOCK):
            raise ValueError(f"matrix: values of shape {matrix.shape}, allowed: ({self._blocks}, {BLOCK}, {BLOCK})")
        if not np.isfinite(matrix).all():
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        self._make(matrix, noise(dtype))
        with np.errstate(over="ignore", under="ignore"):
            made = self._native.take().astype(dtype)
        pivots = made[self.pattern.diagonal]
        if not (np.isfinite(made).all() and (pivots >= np.finfo(made.dtype).tiny).all()):
            raise NotPositiveDefinite(f"matrix: incomplete factor out of the range of {made.dtype}")
        return made

    def _make(self, matrix: NDArray[np.float64], noise: float) -> None:
        raise NotImplementedError


class IncompleteCholesky(Sparse):
    """Never breaks down: where a pivot is not positive it begins again with more on the diagonal (Manteuffel 1980)."""

    def _make(self, matrix: NDArray[np.float64], noise: float) -> None:
        shift, node = 0.0, -1
        for shift in (0.0, *(FIRST_SHIFT * 3.0**k for k in range(SHIFTS))):
            node = self._native.incomplete(matrix, shift, self._method.drop_tolerance, self._method.fill, noise)
            if node < 0:
                self.remedy = f"diagonal shifted by {shift:g}" if shift else ""
                return
        raise NotPositiveDefinite(f"matrix: no incomplete factor, diagonal shifted by up to {shift:g} (node {node})")


class Ssor(Sparse):
    """P = (D/w + L) (D/w)^-1 (D/w + L)^T w / (2 - w) with A = L + D + L^T in blocks (Saad, 2nd edition, 10.2)."""

    def _make(self, matrix: NDArray[np.float64], noise: float) -> None:
        if (node := self._native.ssor(matrix, self._method.omega)) >= 0:
            raise NotPositiveDefinite(f"matrix: diagonal block of node {node} is not positive definite")
