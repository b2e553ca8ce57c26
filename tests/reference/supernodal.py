# SPDX-License-Identifier: MIT
"""Triangular solves with a packed supernodal factor, one column at a time: slow, and meant to be obviously right.

The format (protocol.factor.FactorPattern, and the values that go with it)

A symmetric positive definite matrix A of n degrees of freedom is factorized as P A P^T = L L^T, L lower triangular.

permutation (n,) int32
    Row i of L is degree of freedom permutation[i]: (P x)[i] = x[permutation[i]], (P A P^T)[i, j] =
    A[permutation[i], permutation[j]].
super_start (s + 1,) int32
    Supernode q has the columns super_start[q] <= k < super_start[q + 1]; super_start[0] = 0, super_start[s] = n.
row_start (s + 1,) int64, rows (row_start[s],) int32
    The row list of supernode q is R = rows[row_start[q]:row_start[q + 1]]. It ascends strictly and begins with the
    supernode's own columns, so with c0 = super_start[q] and w columns R[:w] = c0, ..., c0 + w - 1, and R[w:] are
    the rows below, all >= c0 + w.
values (nonzeros,) float32 or float64
    Column by column from left to right, each from its diagonal down. Column k = c0 + j of supernode q holds
    len(R) - j values, those of the rows R[j:], so the first is the diagonal. What stands above the diagonal is not
    stored, nor is there padding. Thus supernode q takes w * len(R) - w * (w - 1) / 2 values, and the first one of
    column k stands where the last one of column k - 1 ends, supernode borders or not. A stored value may be zero.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern


def columns(pattern: FactorPattern, values: NDArray[np.floating]) -> Iterator[tuple[NDArray, NDArray]]:
    """(rows, values) of every column of L from its diagonal down, left to right."""
    at = 0
    for q in range(len(pattern.super_start) - 1):
        row_list = pattern.rows[pattern.row_start[q] : pattern.row_start[q + 1]]
        for j in range(pattern.super_start[q + 1] - pattern.super_start[q]):
            rows = row_list[j:]
            yield rows, values[at : at + len(rows)]
            at += len(rows)
    assert at == len(values)


def lower(pattern: FactorPattern, values: NDArray[np.floating]) -> NDArray[np.float64]:
    """L as a dense matrix, (n, n)."""
    dense = np.zeros((pattern.size, pattern.size))
    for k, (rows, column) in enumerate(columns(pattern, values)):
        dense[rows, k] = column
    return dense


def solve(pattern: FactorPattern, values: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """x with P^T L L^T P x = b, (n,), in float64: forward substitution with L, backward with L^T."""
    x = np.array(b, np.float64)[pattern.permutation]
    whole = list(columns(pattern, values.astype(np.float64)))
    for k, (rows, column) in enumerate(whole):
        x[k] /= column[0]
        x[rows[1:]] -= column[1:] * x[k]
    for k, (rows, column) in reversed(list(enumerate(whole))):
        x[k] = (x[k] - column[1:] @ x[rows[1:]]) / column[0]
    result = np.empty_like(x)
    result[pattern.permutation] = x
    return result
