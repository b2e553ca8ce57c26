# SPDX-License-Identifier: MIT
"""Supernodes: adjacent columns of L that share one list of rows, stored and applied as a dense panel.

Ashcraft and Grimes, The influence of relaxed supernode partitions on the multifrontal method, 1989. The rule for
merging is CHOLMOD's default (Chen, Davis, Hager and Rajamanickam 2008): its supernodes are then exactly these, and its
values are in the order of the pattern without a search.
"""

from typing import NamedTuple

import numpy as np

from precond_worker.symbolic.assembly_tree import AssemblyTree
from precond_worker.symbolic.blocks import BLOCK
from precond_worker.symbolic.elimination import Elimination

# A panel of at most this many columns may hold up to this share of explicit zeros.
ZEROS_BY_WIDTH = ((16, 0.8), (48, 0.1), (np.inf, 0.05))


class Panel(NamedTuple):
    """The columns of nodes first..last; width and height in degrees of freedom."""

    first: int
    last: int
    width: int
    height: int  # rows of the first column, its diagonal included
    zeros: int  # stored, but zero by structure

    @property
    def size(self) -> int:
        """Number of stored values: a triangle on top, a rectangle below."""
        return self.width * (self.width + 1) // 2 + self.width * (self.height - self.width)


def relaxed_supernodes(tree: Elimination) -> list[Panel]:
    """Returns the relaxed supernodes, left to right.

    From the right, each fundamental supernode is merged with the panel after it if that one contains its parent and the
    merged panel holds few enough zeros.
    """
    panels: list[Panel] = []  # right to left
    for panel in reversed(fundamental_supernodes(tree)):
        if panels and panel.last + 1 <= tree.parent[panel.last] <= panels[-1].last:
            joint = merged_panel(panel, panels[-1])
            if worth_merging(joint, panel.zeros + panels[-1].zeros):
                panels[-1] = joint
                continue
        panels.append(panel)
    return panels[::-1]


def fundamental_supernodes(tree: Elimination) -> list[Panel]:
    """Returns the maximal runs of columns, each the only child of the next, with the same rows but for the diagonal."""
    count, parent = tree.count, tree.parent
    children = np.bincount(parent[parent >= 0], minlength=len(parent))
    column = np.arange(len(parent) - 1)
    follows = (parent[:-1] == column + 1) & (count[:-1] == count[1:] + 1) & (children[1:] == 1)
    firsts = np.flatnonzero(np.concatenate([[True], ~follows])).tolist()
    lasts = [*(first - 1 for first in firsts[1:]), len(parent) - 1]
    return [
        Panel(first, last, BLOCK * (last - first + 1), BLOCK * int(count[first]), 0)
        for first, last in zip(firsts, lasts, strict=True)
    ]


def merged_panel(left: Panel, right: Panel) -> Panel:
    """Merges two panels: the columns of `left` get the rows of `right`, which contain their own."""
    added = left.width * (right.height + left.width - left.height)
    return Panel(
        left.first, right.last, left.width + right.width, left.width + right.height, left.zeros + right.zeros + added
    )


def worth_merging(joint: Panel, zeros_before: int) -> bool:
    """True if the zeros of a merged panel cost less than its width gains."""
    share = joint.zeros / joint.size
    return joint.zeros == zeros_before or any(joint.width <= width and share < most for width, most in ZEROS_BY_WIDTH)


def assembly_tree(tree: Elimination) -> AssemblyTree:
    """Returns the relaxed supernodes as fronts."""
    panels = relaxed_supernodes(tree)
    first = np.array([0, *(panel.last + 1 for panel in panels)])
    owner = np.repeat(np.arange(len(panels)), np.diff(first))
    up = tree.parent[first[1:] - 1]
    below = [tree.rows_below(panel.last) for panel in panels]
    below_start = np.cumsum([0, *map(len, below)])
    return AssemblyTree(tree.order, first, np.where(up >= 0, owner[up], -1), below_start, np.concatenate(below))
