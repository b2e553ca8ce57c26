# SPDX-License-Identifier: MIT
"""Block patterns of system matrices: 3 x 3 blocks, one block row per node, both triangles."""

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.arrays import Float64, Int32, Int64

BLOCK = 3  # degrees of freedom of a node


def checked_pattern(row_start: ArrayLike, columns: ArrayLike) -> tuple[Int32, Int32]:
    """Checks a pattern, which may come from the network, and returns it as int32 arrays (nodes + 1,) and (blocks,).

    Raises ValueError unless row_start ascends, the columns of each row ascend strictly and lie in range, every diagonal
    block is present, and each block has its mirror image.
    """
    start, column = np.asarray(row_start), np.asarray(columns)
    if start.ndim != 1 or column.ndim != 1 or start.dtype.kind not in "iu" or column.dtype.kind not in "iu":
        given = f"row_start {start.dtype}{start.shape}, columns {column.dtype}{column.shape}"
        raise ValueError(f"block pattern: {given}, allowed: one-dimensional arrays of integers")
    nodes = len(start) - 1
    if nodes < 1 or start[0] != 0 or start[-1] != len(column) or np.any(start[1:] < start[:-1]):
        raise ValueError(f"block pattern: row_start must ascend from 0 to the number of blocks, {len(column)}")
    if len(column) < nodes:
        raise ValueError("block pattern: every node needs its diagonal block")
    if BLOCK * nodes > np.iinfo(np.int32).max or column.min() < 0 or column.max() >= nodes:
        raise ValueError(f"block pattern: columns must lie between 0 and {nodes - 1}")
    place = rows_of(start).astype(np.int64) * nodes + column
    if np.any(place[1:] <= place[:-1]):
        raise ValueError("block pattern: the columns of a row must ascend strictly")
    mirrored = np.sort(column.astype(np.int64) * nodes + rows_of(start))
    if not np.array_equal(place, mirrored):
        raise ValueError("block pattern: a block has no mirror image, but the pattern must be symmetric")
    if np.count_nonzero(rows_of(start) == column) != nodes:
        raise ValueError("block pattern: every node needs its diagonal block")
    return start.astype(np.int32), column.astype(np.int32)


def rows_of(row_start: NDArray[np.integer]) -> Int64:
    """Returns the block row of each block, (blocks,)."""
    return np.repeat(np.arange(len(row_start) - 1), np.diff(row_start))


def node_norms(row_start: NDArray[np.integer], values: Float64) -> Float64:
    """Returns the scale of diagonal shifts, (nodes,): the norm of the largest block of a row over sqrt(3).

    In a positive definite matrix that is the diagonal block, which may be zero in others.
    """
    return np.maximum.reduceat(np.linalg.norm(values, axis=(1, 2)), row_start[:-1]) / np.sqrt(BLOCK)


def pivot_threshold(dtype: DTypeLike) -> float:
    """Returns the least pivot that is more than rounding error, over the diagonal of its node, for this type.

    A factor with a smaller pivot is worse than none.
    """
    return 1e-7 if np.dtype(dtype) == np.float32 else 1e-13


def degrees_of_freedom(nodes: NDArray[np.integer]) -> Int64:
    """Returns the three degrees of freedom of each node, node by node, (3 * len(nodes),)."""
    return (BLOCK * nodes.astype(np.int64)[:, None] + np.arange(BLOCK)).ravel()


def inverse_permutation(order: NDArray[np.integer]) -> Int64:
    """Returns the inverse of a permutation."""
    inverse = np.empty(len(order), np.int64)
    inverse[order] = np.arange(len(order))
    return inverse
