# SPDX-License-Identifier: MIT
"""The assembly tree of the multifrontal method: which columns each front eliminates, and where what it gets comes from.

Duff and Reid, The multifrontal solution of indefinite sparse symmetric linear equations, 1983.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Int32, Int64
from precond_worker.symbolic.blocks import BLOCK, degrees_of_freedom, inverse_permutation, rows_of


@dataclass(frozen=True)
class AssemblyTree:
    """Fronts in postorder, in nodes (not degrees of freedom).

    order        (n,): node eliminated k-th
    first        (f + 1,): first column of each front
    parent       (f,): front that takes the update matrix, -1 at a root
    below_start  (f + 1,), below: rows under each front's own columns, ascending
    """

    order: Int64
    first: Int64
    parent: Int64
    below_start: Int64
    below: Int64

    @property
    def own(self) -> Int64:
        """Number of columns that each front eliminates, (f,)."""
        return np.diff(self.first)

    def pattern_arrays(self) -> dict[str, NDArray[np.integer]]:
        """Returns the arrays of a protocol.factor.FactorPattern, in degrees of freedom."""
        height = self.own + np.diff(self.below_start)
        start = np.concatenate([[0], np.cumsum(height)])
        rows = np.empty(start[-1], np.int64)
        own = np.repeat(start[:-1] - self.first[:-1], self.own) + np.arange(self.first[-1])
        rows[own] = np.arange(self.first[-1])
        under = np.repeat(start[:-1] + self.own - self.below_start[:-1], np.diff(self.below_start))
        rows[under + np.arange(len(self.below))] = self.below
        return {
            "permutation": degrees_of_freedom(self.order).astype(np.int32),
            "super_start": (BLOCK * self.first).astype(np.int32),
            "row_start": (BLOCK * start).astype(np.int64),
            "rows": degrees_of_freedom(rows).astype(np.int32),
        }


def maps(tree: AssemblyTree) -> Int64:
    """Returns, for each row below a front, its position in the parent's front, in the order of tree.below."""
    fronts = np.repeat(np.arange(len(tree.parent)), np.diff(tree.below_start))
    return place(tree, tree.parent[fronts], tree.below)


def place(tree: AssemblyTree, front: Int64, row: Int64) -> Int64:
    """Returns the position of a row in the rows of a front: own columns first, then those below."""
    nodes = len(tree.order)
    keys = np.repeat(np.arange(len(tree.parent)), np.diff(tree.below_start)) * nodes + tree.below
    below = np.searchsorted(keys, front * nodes + row) - tree.below_start[front] + tree.own[front]
    return np.where(row < tree.first[front + 1], row - tree.first[front], below)


def entries(tree: AssemblyTree, row_start: Int32, columns: Int32) -> tuple[Int64, Int32, Int32]:
    """Returns the blocks of A by column; of two mirrored ones that in the row eliminated later, as on the CPU."""
    rank = inverse_permutation(tree.order)
    row, column = rank[rows_of(row_start)], rank[columns]
    block = np.flatnonzero(row >= column)
    block = block[np.lexsort((row[block], column[block]))]
    front = np.repeat(np.arange(len(tree.parent)), tree.own)
    at = place(tree, front[column[block]], row[block])
    start = np.searchsorted(column[block], np.arange(len(tree.order) + 1))
    return start, block.astype(np.int32), at.astype(np.int32)
