# SPDX-License-Identifier: MIT
"""The plan of the numeric phase, made once per topology: where fronts lie in memory, what is added to each, and when.

A front is a dense symmetric matrix, of which the lower triangle is stored column by column with a stride: first the
columns that it eliminates, then those of its rows below. It is assembled as the sum of its entries of A and of the
update matrices (the rows and columns below) of its children; eliminating its own columns leaves columns of L and its
update matrix. Fronts of one level are independent; each is one level below its parent, so that two halves of memory,
used in turn, hold all fronts that are needed at a time.
"""

from dataclasses import dataclass

import numpy as np

from precond_worker.arrays import Int32, Int64
from precond_worker.gpu.assembly_tree import WIDTH
from precond_worker.symbolic.assembly_tree import AssemblyTree, entries, maps
from precond_worker.symbolic.blocks import BLOCK, inverse_permutation

CHUNK = 2  # nodes whose columns one thread block assembles (multifrontal.cu)
ALIGN = 8  # entries: columns of a front begin at multiples


@dataclass(frozen=True)
class MultifrontalPlan:
    """Fronts are numbered by level, leaves first, those with many own columns first in each.

    level_start  (levels + 1,): first front of each level
    own, rows    (f,): columns that a front eliminates, and all its rows, in degrees of freedom
    stride, at   (f,): entries from column to column, and its first entry in its half of memory (level modulo 2)
    column       (f,): its first column of L
    value        (f,): where that column begins among the values of L (FactorPattern)
    child_start  (f + 1,), child: fronts whose update matrices it takes in, in a fixed order
    map_start    (f + 1,), map: for each node below its own, the node of its parent's front (counted from 0)
    split_start  (f,), split: of its map, where each chunk of CHUNK nodes of its parent begins, and the end
    entry_start  (nodes + 1,), entry_block, entry_row: blocks of A in each node's column: number, node in the front
    half         the two halves of memory, in entries
    """

    level_start: Int64
    own: Int64
    rows: Int64
    stride: Int64
    at: Int64
    column: Int64
    value: Int64
    child_start: Int64
    child: Int64
    map_start: Int64
    map: Int32
    split_start: Int64
    split: Int32
    entry_start: Int64
    entry_block: Int32
    entry_row: Int32
    half: tuple[int, int]
    blocks: int
    nonzeros: int

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.level_start) - 1

    def fronts(self, level: int) -> slice:
        """Returns the fronts of a level."""
        return slice(int(self.level_start[level]), int(self.level_start[level + 1]))

    def steps(self, level: int) -> int:
        """Returns the number of steps of WIDTH columns that eliminate the widest front of a level."""
        return -(-int(self.own[self.fronts(level)].max()) // WIDTH)


def make_plan(tree: AssemblyTree, row_start: Int32, columns: Int32) -> MultifrontalPlan:
    """Makes the plan of a tree of fronts, for matrices of a block pattern (symbolic/blocks.py)."""
    level = levels(tree)
    own = tree.own
    height = own + np.diff(tree.below_start)
    order = np.lexsort((np.arange(len(own)), -height, -own, level))  # the last key counts first
    number = inverse_permutation(order)
    level_start = np.searchsorted(level[order], np.arange(level.max() + 2))
    k, m = BLOCK * own, BLOCK * height
    value = np.concatenate([[0], np.cumsum(k * m - k * (k - 1) // 2)])
    stride = -(-m[order] // ALIGN) * ALIGN
    at, half = _places(stride * m[order], level_start)
    child_start, child = _children(tree.parent, order, number)
    below = maps(tree)
    map_start, map_ = _regrouped(tree.below_start, below, order)
    split_start, split = _splits(tree, height, below, order)
    entry_start, block, row = entries(tree, row_start, columns)
    return MultifrontalPlan(
        level_start, k[order], m[order], stride, at, BLOCK * tree.first[order], value[order], child_start, child,
        map_start, map_.astype(np.int32), split_start, split, entry_start, block, row, half, len(columns),
        int(value[-1]),
    )  # fmt: skip


def levels(tree: AssemblyTree) -> Int64:
    """Returns the level of each front, (f,): its parent's less one; of a root its height."""
    parent = tree.parent.tolist()
    level = [0] * len(parent)
    for front, up in enumerate(parent):  # heights
        if up >= 0:
            level[up] = max(level[up], level[front] + 1)
    for front in range(len(parent) - 1, -1, -1):
        if parent[front] >= 0:
            level[front] = level[parent[front]] - 1
    return np.array(level)


def _places(sizes: Int64, level_start: Int64) -> tuple[Int64, tuple[int, int]]:
    """Returns the first entry of each front in its half, and the sizes of the halves."""
    end = np.cumsum(sizes)
    at = end - sizes
    before = at[level_start[:-1]]
    held = np.append(before[1:], end[-1]) - before
    return at - np.repeat(before, np.diff(level_start)), (int(held[::2].max()), int(held[1::2].max(initial=0)))


def _children(parent: Int64, order: Int64, number: Int64) -> tuple[Int64, Int64]:
    """Returns the children of each front in the order of their columns, with new numbers of fronts."""
    has = np.flatnonzero(parent >= 0)
    by_parent = has[np.argsort(number[parent[has]], kind="stable")]
    counts = np.bincount(number[parent[has]], minlength=len(order))
    return np.concatenate([[0], np.cumsum(counts)]), number[by_parent]


def _regrouped(start: Int64, values: Int64, order: Int64) -> tuple[Int64, Int64]:
    """Permutes lists of fronts; returns their starts and values."""
    length = np.diff(start)[order]
    new = np.concatenate([[0], np.cumsum(length)])
    source = np.repeat(start[order] - new[:-1], length) + np.arange(new[-1])
    return new, values[source]


def _splits(tree: AssemblyTree, height: Int64, maps: Int64, order: Int64) -> tuple[Int64, Int32]:
    """Returns where the chunks of its parent begin in each front's map; a root has none."""
    chunks = np.where(tree.parent >= 0, -(-height[tree.parent] // CHUNK) + 1, 0)
    start = np.concatenate([[0], np.cumsum(chunks)])
    front = np.repeat(np.arange(len(chunks)), chunks)
    first_node = (np.arange(start[-1]) - start[front]) * CHUNK
    wide = int(height.max()) + CHUNK + 1
    keys = np.repeat(np.arange(len(chunks)), np.diff(tree.below_start)) * wide + maps
    found = np.searchsorted(keys, front * wide + np.minimum(first_node, wide - 1)) - tree.below_start[front]
    return start[:-1][order], found.astype(np.int32)
