# SPDX-License-Identifier: MIT
"""From block values to the columns of the permuted matrix, by an index map that is made once per topology."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix

from precond_worker.blocks import BLOCK, Index, inverse_permutation, rows_of


class Gather:
    """Writes the values of new matrices into a fixed sparse matrix.

    matrix: the csc_matrix, float64; its pattern never changes, and zeros among the values stay in it.
    """

    def __init__(self, numbered: csc_matrix):
        """numbered: csc_matrix whose data say which of the block values (counted from 0) goes there."""
        numbered.sort_indices()
        self._source = numbered.data
        self.matrix = csc_matrix((np.zeros(numbered.nnz), numbered.indices, numbered.indptr), shape=numbered.shape)

    def fill(self, values: NDArray[np.float64]) -> csc_matrix:
        """The matrix with these block values, (blocks, 3, 3). The next call overwrites it."""
        np.take(values.reshape(-1), self._source, out=self.matrix.data, mode="clip")  # clip: needs no buffer
        return self.matrix


def lower_triangle(row_start: Index, columns: Index, order: NDArray[np.int64]) -> csc_matrix:
    """Lower triangle of P A P^T, numbered for Gather.

    Of two mirrored blocks only that in the row of the node eliminated later is read, and of a diagonal block the
    lower triangle: whatever stands in the others has no effect.
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


def mirrored(lower: csc_matrix) -> csc_matrix:
    """Both triangles of a numbered lower triangle; mirrored entries read the same value."""
    entries = lower.tocoo()
    off = entries.row > entries.col
    source = np.concatenate([entries.data, entries.data[off]])
    row = np.concatenate([entries.row, entries.col[off]])
    col = np.concatenate([entries.col, entries.row[off]])
    return csc_matrix(coo_matrix((source, (row, col)), shape=lower.shape))
