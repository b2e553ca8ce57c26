# SPDX-License-Identifier: MIT
"""Numeric factorization by SciPy's SuperLU, for where scikit-sparse is not installed.

An LU factorization of a symmetric matrix without pivoting is L D L^T with D the diagonal of U, so the Cholesky factor
is L sqrt(D). It computes both L and U, hence about twice the arithmetic.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from precond_worker.errors import NotPositiveDefinite
from precond_worker.triangle import Gather, mirrored


class SuperLU:
    """LL^T of matrices of one pattern, in the order in which their columns stand."""

    def __init__(self, lower: csc_matrix):
        """lower: numbered lower triangle (triangle.py), already in the order of elimination."""
        self._gather = Gather(mirrored(lower))
        self._natural = np.arange(lower.shape[0])

    def factorize(self, values: NDArray[np.float64]) -> csc_matrix:
        """L of the block values (blocks, 3, 3), without the entries that happen to be zero, rows in no order.

        Raises NotPositiveDefinite where a pivot is not positive or had to be looked for off the diagonal.
        """
        unit, pivots, _ = self.ldl(values)
        if not np.all(pivots > 0):
            raise NotPositiveDefinite("pivot not positive", column=int(np.argmax(~(pivots > 0))))
        scale = np.repeat(np.sqrt(pivots), np.diff(unit.indptr))
        return csc_matrix((unit.data * scale, unit.indices, unit.indptr), shape=unit.shape)

    def ldl(self, values: NDArray[np.float64]) -> tuple[csc_matrix, NDArray[np.float64], NDArray[np.float64]]:
        """L with a unit diagonal, D (n,) of any sign and the diagonal of the matrix; raises NotPositiveDefinite where a
        pivot had to be looked for off the diagonal."""
        matrix = self._gather.fill(values)
        try:
            # relax=1: with 24 the SuperLU of SciPy 1.17 writes past its arrays.
            lu = splu(
                matrix,
                permc_spec="NATURAL",
                diag_pivot_thresh=0.0,
                relax=1,
                options={"SymmetricMode": True, "Equil": False},
            )
        except RuntimeError as error:  # exactly singular
            raise NotPositiveDefinite("pivot not positive") from error
        if not np.array_equal(lu.perm_c, self._natural):
            raise RuntimeError("SuperLU permuted a matrix that it was to factorize in its natural order")
        pivots = lu.U.diagonal()
        moved = lu.perm_r != self._natural
        if np.any(moved):
            raise NotPositiveDefinite("pivot not positive", column=int(np.argmax(moved | ~(pivots > 0))))
        return csc_matrix(lu.L), pivots, matrix.diagonal()
