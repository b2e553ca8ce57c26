# SPDX-License-Identifier: MIT
"""The Cholesky factor by SciPy's SuperLU: an LU factorization of a symmetric matrix without pivoting is L D L^T with D
the diagonal of U. And factors as matrices."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import splu

from protocol.factor import FactorPattern


class SuperLU:
    """LL^T of P A P^T for matrices of one block pattern."""

    def __init__(self, row_start: NDArray[Any], columns: NDArray[Any], permutation: NDArray[Any]):
        places = np.arange(9 * len(columns), dtype=np.int64).reshape(-1, 3, 3) + 1  # a stored 0 would be dropped
        numbered = bsr_matrix((places, columns, row_start)).tocsr()[permutation][:, permutation].tocsc()
        numbered.sort_indices()
        self._source, self._pattern = numbered.data - 1, numbered

    def factorize(self, values: NDArray[np.float64]) -> csc_matrix:
        """L of the block values."""
        p = self._pattern
        matrix = csc_matrix((values.reshape(-1)[self._source], p.indices, p.indptr), shape=p.shape)
        # relax=1: with 24 the SuperLU of SciPy 1.17 writes past its arrays.
        lu = splu(
            matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1,
            options={"SymmetricMode": True, "Equil": False},
        )  # fmt: skip
        unit = lu.L
        scale = np.repeat(np.sqrt(lu.U.diagonal()), np.diff(unit.indptr))
        return csc_matrix((unit.data * scale, unit.indices, unit.indptr), shape=unit.shape)


def lower_of(pattern: FactorPattern, values: NDArray[np.float64]) -> csc_matrix:
    """L as a sparse matrix."""
    start = np.append(pattern.diagonal, pattern.nonzeros)
    width = np.diff(pattern.super_start)
    first = np.repeat(pattern.row_start[:-1] - pattern.super_start[:-1], width) + np.arange(pattern.size)
    within = np.arange(pattern.nonzeros) - np.repeat(start[:-1], np.diff(start))
    return csc_matrix((values, pattern.rows[np.repeat(first, np.diff(start)) + within], start))
