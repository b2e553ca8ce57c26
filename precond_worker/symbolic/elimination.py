# SPDX-License-Identifier: MIT
"""The elimination tree of the nodes and the pattern of the columns of L, before any value is known.

Davis, Direct Methods for Sparse Linear Systems, 2006, chapter 4. Eliminating a node couples its remaining neighbours;
the first of them to be eliminated is the parent of the node. Indices are of nodes; supernodes.py expands them to
degrees of freedom.
"""

import ctypes as c
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Int32, Int64
from precond_worker.symbolic.blocks import inverse_permutation, rows_of
from precond_worker.symbolic.compiled import compiled

SOURCE = Path(__file__).with_suffix(".cpp")


class Columns(NamedTuple):
    """Columns of L in the given order. A run of columns, each the only child of the next, with the same rows but for
    the diagonal, has the rows of its last column.

    parent (n,): -1 at a root. entries (n,): of a column, the diagonal included
    length (n,): rows below the diagonal, unsorted, of the last column of a run; -1: of the others. first (n,), rows:
        where they are
    """

    parent: Int64
    entries: Int64
    first: Int64
    length: Int64
    rows: Int32


@dataclass(frozen=True)
class Elimination:
    """Columns of L, node by node, in an order in which every subtree is contiguous (a postorder).

    order   (n,): node eliminated k-th
    parent  (n,): parent of column k, -1 at a root
    count   (n,): entries of column k, the diagonal included
    """

    order: Int64
    parent: Int64
    count: Int64
    _rank: Int64  # of a column in the order before the postorder
    _last: Int64  # of the run of each column
    _first: Int64
    _length: Int64
    _rows: Int32  # in the order before the postorder

    def rows_below(self, column: int) -> Int64:
        """Returns the rows of a column below its diagonal, ascending."""
        last = int(self._last[column])
        first = int(self._first[last])
        below = np.sort(self._rank[self._rows[first : first + int(self._length[last])]])
        return np.concatenate([np.arange(column + 1, last + 1), below])


def eliminate(row_start: Int32, columns: Int32, order: Int64) -> Elimination:
    """Factorizes symbolically in a postorder, which has the same fill as the given order.

    In a postorder far more columns share a supernode: half as many supernodes, and a numeric phase a quarter shorter at
    24,000 tetrahedra.
    """
    found = native_columns(row_start, columns, order) or columns_of(*column_structures(row_start, columns, order))
    after = postorder(found.parent, found.entries)
    rank = inverse_permutation(after)
    parents = np.where(found.parent[after] >= 0, rank[found.parent[after]], -1)
    length = found.length[after]
    ends = np.flatnonzero(length >= 0)  # runs are contiguous in a postorder
    last = ends[np.searchsorted(ends, np.arange(len(after)))]
    return Elimination(
        order[after], parents, found.entries[after], rank, last, found.first[after], length, found.rows
    )  # fmt: skip


@cache
def _library() -> c.CDLL | None:
    library, p, n = compiled(SOURCE), c.c_void_p, c.c_int64
    if library is None:
        return None
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "eliminate_columns": (p, [n, *[p] * 8]), "eliminate_rows": (None, [p, p]), "eliminate_free": (None, [p])
    }  # fmt: skip
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def native_columns(row_start: Int32, columns: Int32, order: Int64) -> Columns | None:
    """Returns the columns of L by native code, which takes a twentieth of the time; None where it is not to be had.

    row_start, columns: a checked pattern (blocks.checked_pattern). order: a permutation.
    """
    library = _library()
    if library is None:
        return None
    nodes = len(order)
    start, column = np.ascontiguousarray(row_start, np.int32), np.ascontiguousarray(columns, np.int32)
    given = np.ascontiguousarray(order, np.int64)
    parent, count, first, length = (np.empty(nodes, np.int64) for _ in range(4))
    total = np.zeros(1, np.int64)
    made = library.eliminate_columns(
        nodes, *(a.ctypes.data for a in (start, column, given, parent, count, first, length, total))
    )
    try:
        rows = np.empty(int(total[0]), np.int32)
        library.eliminate_rows(made, rows.ctypes.data)
    finally:
        library.eliminate_free(made)
    return Columns(parent, count, first, length, rows)


def columns_of(parent: Int64, below: list[Int32]) -> Columns:
    """Returns the columns of L of their parents and rows."""
    count = np.array([len(rows) + 1 for rows in below])
    children = np.bincount(parent[parent >= 0], minlength=len(parent))
    goes_on = parent >= 0
    goes_on[goes_on] = (count[goes_on] == count[parent[goes_on]] + 1) & (children[parent[goes_on]] == 1)
    length = np.where(goes_on, -1, count - 1)
    kept = np.maximum(length, 0)
    rows = np.concatenate([below[k] for k in np.flatnonzero(~goes_on)])
    return Columns(parent, count, np.cumsum(kept) - kept, length, rows)


def column_structures(row_start: Int32, columns: Int32, order: Int64) -> tuple[Int64, list[Int32]]:
    """Returns parent and rows below the diagonal (unsorted) of every column of L."""
    nodes = len(order)
    later = later_neighbours(row_start, columns, order)
    children: list[list[int]] = [[] for _ in range(nodes)]
    alive: dict[int, set[int]] = {}  # structures not merged into that of their parent yet
    parent = np.full(nodes, -1)
    below = []
    for node in range(nodes):
        rows = merged([alive.pop(child) for child in children[node]])
        rows.update(later[node])
        rows.discard(node)
        below.append(np.fromiter(rows, np.int32, len(rows)))
        if rows:
            parent[node] = min(rows)
            children[parent[node]].append(node)
            alive[node] = rows
    return parent, below


def later_neighbours(row_start: Int32, columns: Int32, order: Int64) -> list[list[int]]:
    """Returns, for every step of the elimination, the neighbours that are eliminated later."""
    rank = inverse_permutation(order)
    first, second = rank[rows_of(row_start)], rank[columns]
    upper = second > first
    first, second = first[upper], second[upper]
    by_row = np.argsort(first, kind="stable")
    ends = np.cumsum(np.bincount(first, minlength=len(order))).tolist()
    flat = second[by_row].tolist()
    return [flat[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]


def merged(sets: list[set[int]]) -> set[int]:
    """Returns the union of sets, built in the largest; the others are not needed any more."""
    if not sets:
        return set()
    largest = max(sets, key=len)
    for other in sets:
        if other is not largest:
            largest |= other
    return largest


def postorder(parent: Int64, weight: NDArray[np.integer]) -> Int64:
    """Orders the nodes of a forest: children before parents, every subtree contiguous, the heaviest child last.

    The last child is next to its parent, so that the two can share a supernode; the heaviest one adds the fewest zeros.
    """
    children: list[list[int]] = [[] for _ in range(len(parent) + 1)]  # the last list holds the roots, parent -1
    for node in np.argsort(weight, kind="stable").tolist():
        children[parent[node]].append(node)
    backwards = []  # parents first, heaviest child first
    stack = children[-1]
    while stack:
        node = stack.pop()
        backwards.append(node)
        stack.extend(children[node])
    return np.array(backwards[::-1])
