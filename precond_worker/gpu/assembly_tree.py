# SPDX-License-Identifier: MIT
"""The tree of fronts for a GPU: larger and fewer than the supernodes of the CPU.

A launch costs a GPU more than the arithmetic on many explicit zeros, so small neighbours become one front, also where
a parent has several children (on the CPU only the last child may join its parent, since the order of elimination stays
as it is). The order is then a postorder of the merged tree; the fill without those zeros is the same. Duff and Reid,
The multifrontal solution of indefinite sparse symmetric linear equations, 1983.
"""

import numpy as np

from precond_worker.arrays import Int64
from precond_worker.symbolic.assembly_tree import AssemblyTree
from precond_worker.symbolic.blocks import BLOCK, inverse_permutation
from precond_worker.symbolic.elimination import Elimination, postorder
from precond_worker.symbolic.supernodes import Panel, fundamental_supernodes

WIDTH = 64  # degrees of freedom that the kernels eliminate in one step (multifrontal.cu)
ZEROS = 0.05  # largest share of explicit zeros of a merged front
ZEROS_IN_ONE_STEP = 0.5  # the same, of a front that is eliminated in a single step


def assembly_tree(tree: Elimination) -> AssemblyTree:
    """Returns the fronts for an elimination tree of nodes."""
    panels = fundamental_supernodes(tree)
    owner, parent = merged(panels, parents(panels, tree))
    heads = np.flatnonzero(owner == np.arange(len(panels)))  # the topmost panel of each front: its rows are the front's
    width = np.array([panel.width for panel in panels]) // BLOCK
    columns = np.bincount(owner, width, len(panels)).astype(np.int64)[heads]
    up = np.where(parent[heads] >= 0, owner[parent[heads]], -1)
    number = np.full(len(panels), -1)
    number[heads] = np.arange(len(heads))
    up = np.where(up >= 0, number[up], -1)
    below_top = np.array([(panels[head].height - panels[head].width) // BLOCK for head in heads])
    weight = columns + below_top
    after = postorder(up, weight)  # fronts, children first
    rank = inverse_permutation(after)
    front_of = rank[number[owner]].repeat(width)  # of each column in the old order
    place = inverse_permutation(order := np.argsort(front_of, kind="stable"))
    below = [place[tree.rows_below(panels[heads[front]].last)] for front in after]
    below_start = np.concatenate([[0], np.cumsum([len(rows) for rows in below])]).astype(np.int64)
    parent_of = np.where(up[after] >= 0, rank[up[after]], -1)
    first = np.concatenate([[0], np.cumsum(columns[after])])
    return AssemblyTree(tree.order[order], first, parent_of, below_start, _sorted(below, len(place)))


def _sorted(lists: list[Int64], nodes: int) -> Int64:
    """Concatenates the lists, each sorted."""
    flat = np.concatenate(lists).astype(np.int64)
    which = np.repeat(np.arange(len(lists)), [len(rows) for rows in lists])
    return np.sort(which * nodes + flat) - which * nodes


def parents(panels: list[Panel], tree: Elimination) -> Int64:
    """Returns the parent of each panel, -1 at a root."""
    panel_of = np.repeat(np.arange(len(panels)), [panel.last - panel.first + 1 for panel in panels])
    column = tree.parent[[panel.last for panel in panels]]
    return np.where(column >= 0, panel_of[column], -1)


def merged(panels: list[Panel], parent: Int64) -> tuple[Int64, Int64]:
    """Returns, for each panel, the topmost panel of its front, and its parent in the tree.

    From the leaves up, each front is merged with those of its children that add few zeros, those with the most rows
    first.
    """
    width, height = [p.width for p in panels], [p.height for p in panels]
    zeros = [p.zeros for p in panels]
    owner = np.arange(len(panels))
    children: list[list[int]] = [[] for _ in panels]
    for top in range(len(panels)):
        kept: list[int] = []
        for child in sorted(children[top], key=lambda c: height[c] - width[c], reverse=True):
            joint = _joint(width, height, zeros, child, top)
            if joint is None:
                kept.append(child)
                continue
            width[top], height[top], zeros[top] = joint
            owner[child] = top
            kept += children[child]
        children[top] = kept
        if parent[top] >= 0:
            children[parent[top]].append(top)
    for panel in range(len(panels) - 1, -1, -1):  # owners of owners
        owner[panel] = owner[owner[panel]]
    return owner, parent


def _joint(
    width: list[int], height: list[int], zeros: list[int], child: int, top: int
) -> tuple[int, int, int] | None:  # fmt: skip
    """Returns width, height and explicit zeros of two merged fronts; None if these are too many zeros."""
    added = width[child] * (height[top] + width[child] - height[child])
    joint = Panel(0, 0, width[child] + width[top], width[child] + height[top], zeros[child] + zeros[top] + added)
    share = joint.zeros / joint.size
    if share <= ZEROS or (joint.width <= WIDTH and share <= ZEROS_IN_ONE_STEP):
        return joint.width, joint.height, joint.zeros
    return None
