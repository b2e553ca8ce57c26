# SPDX-License-Identifier: MIT
"""Partition of the elimination tree of L into groups of levels, and of each group into connected parts.

Alvarado, Pothen and Schreiber, Highly parallel sparse triangular solution, 1993: the inverse of L as a product of few
sparse factors. Here the supernodes of a part are treated as one dense block, so that applying the factor takes two
phases per group without dependencies inside. Runs on the host, once per pattern.
"""

import ctypes as c
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Int64
from sim_server.backends.compiler import native

Count = TypeVar("Count", int, NDArray[Any])
TEXT = "backends/gpu/inverse/tree_cuts.cpp"
NODE = 3  # degrees of freedom of a node
COLUMNS, ROWS = 32, 8  # of a chunk of the stored matrices


def padded(count: Count, step: int) -> Count:
    """Returns the next multiple of `step`."""
    return -(-count // step) * step


@dataclass(frozen=True)
class Tree:
    """Elimination tree of the supernodes of a pattern.

    parent (s,): -1 at a root
    width, height (s,): degrees of freedom of the columns, and of the columns with the rows below
    """

    pattern: FactorPattern
    parent: Int64
    width: Int64
    height: Int64

    @cached_property
    def size(self) -> Int64:
        """Degrees of freedom of the columns of each whole subtree, (s,)."""
        size = self.width.tolist()
        for s, p in enumerate(self.parent.tolist()):
            if p >= 0:
                size[p] += size[s]
        return np.array(size)


class Partition(NamedTuple):
    """Parts of the elimination tree; groups of children come before those of their parents.

    groups: P
    part (s,): part of each supernode
    group (parts,): 0 .. P - 1; parts of the last group have no boundary
    root (parts,): a supernode whose rows below are the boundary of the part
    v, b (parts,): degrees of freedom inside and in the boundary
    """

    groups: int
    part: Int64
    group: Int64
    root: Int64
    v: Int64
    b: Int64


def tree_of(pattern: FactorPattern) -> Tree:
    """Builds the elimination tree of a pattern.

    Raises ValueError if rows do not come in whole nodes, or if the pattern is not that of a Cholesky factor, i.e. a row
    below a supernode is missing in its parent.
    """
    _check_nodes(pattern)
    start, row_start, rows = pattern.super_start.astype(np.int64), pattern.row_start, pattern.rows
    width, height = np.diff(start), np.diff(row_start)
    below = height > width
    parent = np.full(len(width), -1)
    first = rows[(row_start[:-1] + width)[below]]
    parent[below] = np.searchsorted(start, first, side="right") - 1
    tree = Tree(pattern, parent, width, height)
    _check_closed(tree)
    return tree


def _check_nodes(pattern: FactorPattern) -> None:
    def whole(values: NDArray[Any]) -> bool:
        if len(values) % NODE:
            return False
        triples = values.reshape(-1, NODE)
        return bool((triples[:, 0] % NODE == 0).all() and (triples - triples[:, :1] == np.arange(NODE)).all())

    starts_fit = (pattern.super_start % NODE == 0).all() and (pattern.row_start % NODE == 0).all()
    if not (starts_fit and whole(pattern.permutation) and whole(pattern.rows)):
        raise ValueError(
            "FactorPattern: supernodes, rows and permutation must keep the 3 degrees of freedom of a node together "
            "on a GPU; a factor in another order is applied on the CPU only"
        )


def _check_closed(tree: Tree) -> None:
    """Raises ValueError unless every row below a supernode is a column or a row of its parent."""
    pattern, n = tree.pattern, tree.pattern.size // NODE
    node_rows = pattern.rows[::NODE].astype(np.int64) // NODE
    counts = tree.height // NODE
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(node_rows)) - np.repeat(pattern.row_start[:-1] // NODE, counts)
    below = within >= (tree.width // NODE)[owner]
    wanted = tree.parent[owner[below]] * n + node_rows[below]
    known = owner * n + node_rows  # ascends
    found = np.searchsorted(known, wanted)
    if len(wanted) and not np.array_equal(known[np.minimum(found, len(known) - 1)], wanted):
        raise ValueError("FactorPattern.rows: rows below a supernode are missing in its parent; not a Cholesky factor")


def partition(tree: Tree, thresholds: tuple[int, ...]) -> Partition:
    """Cuts the tree where the degrees of freedom of a subtree exceed one of the ascending thresholds.

    Parts without a boundary (whole trees, or their tops) are in the last group. Of those, trees of a few nodes (e.g.
    fixed ones) share a part of one chunk's width.
    """
    part, group, root, v, b = (np.empty(len(tree.parent), np.int64) for _ in range(5))
    count = library().tree_partition(
        *tree_arguments(tree, thresholds), *(a.ctypes.data for a in (part, group, root, v, b))
    )
    return Partition(len(thresholds) + 1, part, *(a[:count].copy() for a in (group, root, v, b)))


@cache
def library() -> c.CDLL:
    """Compiles and loads tree_cuts.cpp."""
    p, n, x = c.c_void_p, c.c_int64, c.c_double
    tree = [n, p, p, p, p, p, n]
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "tree_partition": (n, [*tree, *[p] * 5]), "tree_estimate": (x, [*tree, n, n, n]),
        "tree_predict": (x, [*tree, n, n, n]), "tree_phase": (n, [n, n, p, p, p, n, n, p, p, p]),
        "balance_tiles": (n, [n, p, p, p, n, p]),
    }  # fmt: skip
    return native(TEXT, signatures, stepping=False)  # Gpu.build names it


def tree_arguments(tree: Tree, thresholds: tuple[int, ...]) -> tuple[Any, ...]:
    """Returns the arguments of a function of the library that describe a tree and its cuts."""
    cuts = (c.c_int64 * max(len(thresholds), 1))(*thresholds)
    arrays = (a.ctypes.data for a in (tree.parent, tree.width, tree.height, tree.size))
    return len(tree.parent), *arrays, cuts, len(thresholds)
