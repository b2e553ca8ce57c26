# SPDX-License-Identifier: MIT
"""The elimination tree of L cut into groups of levels, and the connected pieces of a group: parts.

Alvarado, Pothen and Schreiber, Highly parallel sparse triangular solution, 1993: the inverse of L as a product of few
sparse factors. Here the supernodes of a part are treated as one dense block, so that applying the factor takes two
phases per group and none of them has a dependency inside. Host code, once per pattern.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern

Ints = NDArray[np.int64]
NODE = 3  # degrees of freedom of a node
COLUMNS, ROWS = 32, 8  # of a chunk of the stored matrices


def padded(count: Any, step: int) -> Any:
    """The next multiple of `step`."""
    return -(-count // step) * step


@dataclass(frozen=True)
class Tree:
    """The supernodes of a pattern. parent (s,), -1 at a root; width, height, size (s,): degrees of freedom of the
    columns, of the columns with the rows below, and of the columns of the whole subtree."""

    pattern: FactorPattern
    parent: Ints
    width: Ints
    height: Ints

    @cached_property
    def size(self) -> Ints:
        size = self.width.tolist()
        for s, p in enumerate(self.parent.tolist()):
            if p >= 0:
                size[p] += size[s]
        return np.array(size)


class Partition(NamedTuple):
    """Parts, the children's groups before the parents'.

    part (s,): of each supernode. Of each part, (parts,): group 0..P-1, the last one's parts having no rows below;
    root: a supernode whose rows below are the part's boundary; v, b: degrees of freedom inside and in the boundary.
    """

    groups: int
    part: Ints
    group: Ints
    root: Ints
    v: Ints
    b: Ints


def tree_of(pattern: FactorPattern) -> Tree:
    """Raises ValueError if rows do not come in whole nodes, or if they are not those of a Cholesky factor: what lies
    below a supernode's parent is not among its parent's rows."""
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
    """Every row below a supernode is a column or a row of its parent."""
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
    """Cuts where the degrees of freedom of a subtree pass one of the ascending thresholds. Parts without a boundary
    (of whole trees, or of their tops) are in the last group whatever their size."""
    groups = len(thresholds) + 1
    level = np.searchsorted(np.asarray(thresholds), tree.size, side="left")
    label = np.arange(len(level)).tolist()
    parent, levels = tree.parent.tolist(), level.tolist()
    for s in range(len(parent) - 1, -1, -1):
        if parent[s] >= 0 and levels[s] == levels[parent[s]]:
            label[s] = label[parent[s]]
    root, part = np.unique(label, return_inverse=True)  # a part is named after its root
    b = (tree.height - tree.width)[root]
    v = np.bincount(part, tree.width, len(root)).astype(np.int64)
    group = np.where(b == 0, groups - 1, level[root])
    joined = _join_small(v, b)
    part, v = joined[part], np.bincount(joined, v).astype(np.int64)
    keep = np.unique(joined, return_index=True)[1]
    root, b, group = root[keep], b[keep], group[keep]
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return Partition(groups, rank[part], group[order], root[order], v[order], b[order])


def _join_small(v: Ints, b: Ints) -> Ints:
    """New number of each part: trees of a few nodes (fixed nodes are trees of one) share parts of one column of
    chunks."""
    label, small = np.arange(len(v)), np.flatnonzero((b == 0) & (v <= COLUMNS // 2))
    room, home = 0, -1
    for s in small.tolist():
        if v[s] > room:
            room, home = COLUMNS, s
        room -= int(v[s])
        label[s] = home
    return np.unique(label, return_inverse=True)[1]
