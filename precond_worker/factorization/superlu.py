# SPDX-License-Identifier: MIT
"""Numeric factorization by SciPy's SuperLU, for where scikit-sparse is not installed.

An LU factorization of a symmetric matrix without pivoting is L D L^T with D the diagonal of U, so the Cholesky factor
is L sqrt(D). It computes both L and U, hence about twice the arithmetic.
"""

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from precond_worker.arrays import Float64
from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization.permuted_csc import PermutedMatrix, mirrored


class SuperLU:
    """LL^T of matrices of one pattern, in their natural order."""

    def __init__(self, lower: csc_matrix):
        """lower: numbered lower triangle (permuted_csc.py) in the order of elimination."""
        self._matrix = PermutedMatrix(mirrored(lower))
        self._natural = np.arange(lower.shape[0])

    def factorize(self, values: Float64) -> csc_matrix:
        """Returns L of the block values (blocks, 3, 3), without entries that are zero by chance, rows unsorted.

        Raises NotPositiveDefinite if a pivot is not positive or was taken off the diagonal.
        """
        unit, pivots, _ = self.ldl(values)
        if not np.all(pivots > 0):
            raise NotPositiveDefinite("pivot not positive", column=int(np.argmax(~(pivots > 0))))
        scale = np.repeat(np.sqrt(pivots), np.diff(unit.indptr))
        return csc_matrix((unit.data * scale, unit.indices, unit.indptr), shape=unit.shape)

    def ldl(self, values: Float64) -> tuple[csc_matrix, Float64, Float64]:
        """Returns L with a unit diagonal, D (n,) of any sign and the diagonal of the matrix.

        Raises NotPositiveDefinite if a pivot was taken off the diagonal.
        """
        matrix = self._matrix.fill(values)
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
