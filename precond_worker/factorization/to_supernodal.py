# SPDX-License-Identifier: MIT
"""Conversion of the sparse L of a library to the values of a supernodal pattern."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from protocol.factor import FactorPattern


class Packer:
    """Puts the values of L in the order of one pattern, with or without explicit zeros of the library.

    CHOLMOD stores its supernodes column by column (SuiteSparse 5 and 7: change_factor copies whole panels, explicit
    zeros included), and the pattern follows its rule for merging, so that its values are copied as they are. Entries of
    its LDL^T, which is not supernodal, and of a CHOLMOD that merges differently are scattered.
    """

    def __init__(self, pattern: FactorPattern):
        self._pattern = pattern
        self._column_start = np.append(pattern.diagonal, pattern.nonzeros)
        first = self._column_start[pattern.super_start[:-1]]  # of each supernode, then all entries of first columns
        shift = np.repeat(first - pattern.row_start[:-1], np.diff(pattern.row_start))
        self._first_columns = shift + np.arange(len(shift))

    def pack(self, factor: csc_matrix, out: NDArray[np.floating]) -> None:
        """Writes the values of L to out, (nonzeros,), rounded to its type; 0 where the library has no entry.

        Raises RuntimeError if L has an entry outside the pattern that is not zero.
        """
        if self.is_packed(factor):
            out[:] = factor.data
        else:
            self._scatter(factor, out)

    def is_packed(self, factor: csc_matrix) -> bool:
        """True if the library's columns are those of the pattern.

        The first column of each supernode is compared. That is enough: in a Cholesky factor the rows of a column are
        among those of its parent, the next column, and the lengths exclude others.
        """
        return np.array_equal(factor.indptr, self._column_start) and np.array_equal(
            factor.indices[self._first_columns], self._pattern.rows
        )

    def _scatter(self, factor: csc_matrix, out: NDArray[np.floating]) -> None:
        starts, row_start = self._pattern.super_start.tolist(), self._pattern.row_start.tolist()
        place = np.full(self._pattern.size, -1)  # of each row in the supernode's list
        out[:] = 0
        for supernode, (c0, c1) in enumerate(pairwise(starts)):
            rows = self._pattern.rows[row_start[supernode] : row_start[supernode + 1]]
            place[rows] = np.arange(len(rows))
            entries = slice(factor.indptr[c0], factor.indptr[c1])
            within = np.repeat(np.arange(c1 - c0), np.diff(factor.indptr[c0 : c1 + 1]))  # column of each entry
            below = place[factor.indices[entries]] - within  # its distance from the diagonal in the list
            known = below >= 0
            values = factor.data[entries]
            if np.any(values[~known]):
                raise RuntimeError("the library's factor does not fit the symbolic factorization")
            out[(self._column_start[c0 + within] + below)[known]] = values[known]
            place[rows] = -1
