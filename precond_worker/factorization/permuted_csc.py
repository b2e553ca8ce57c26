# SPDX-License-Identifier: MIT
"""Permuted matrices in compressed columns, filled from block values by an index map made once per topology."""

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from precond_worker.arrays import Float64, Int32, Int64
from precond_worker.symbolic.blocks import BLOCK, inverse_permutation, rows_of


class PermutedMatrix:
    """A sparse matrix of a fixed pattern, filled with the values of one matrix after another.

    matrix: csc_matrix, float64, with explicit zeros.
    """

    def __init__(self, numbered: csc_matrix):
        """numbered: csc_matrix whose data are indices of block values (counted from 0)."""
        numbered.sort_indices()
        self._source = numbered.data
        self.matrix = csc_matrix((np.zeros(numbered.nnz), numbered.indices, numbered.indptr), shape=numbered.shape)

    def fill(self, values: Float64) -> csc_matrix:
        """Returns the matrix with these block values, (blocks, 3, 3). The next call overwrites it."""
        np.take(values.reshape(-1), self._source, out=self.matrix.data, mode="clip")  # clip: needs no buffer
        return self.matrix


def lower_triangle(row_start: Int32, columns: Int32, order: Int64) -> csc_matrix:
    """Returns the lower triangle of P A P^T, numbered for PermutedMatrix.

    Of two mirrored blocks only that in the row of the node eliminated later is read, and of a diagonal block the lower
    triangle; the other values have no effect.
    """
    rank = inverse_permutation(order)
    rows, cols = rank[rows_of(row_start)], rank[columns]
    blocks = np.flatnonzero(rows >= cols)
    i, j = (axis.ravel() for axis in np.indices((BLOCK, BLOCK)))
    row = (BLOCK * rows[blocks, None] + i).ravel()
    col = (BLOCK * cols[blocks, None] + j).ravel()
    source = (BLOCK * BLOCK * blocks[:, None] + BLOCK * i + j).ravel()
    keep = row >= col
    size = BLOCK * len(order)
    return csc_matrix(coo_matrix((source[keep], (row[keep], col[keep])), shape=(size, size)))
