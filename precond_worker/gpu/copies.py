# SPDX-License-Identifier: MIT
"""Many matrices of one pattern as the blocks of one: their fronts are factorized in the launches of a single matrix."""

from dataclasses import dataclass

import numpy as np

from precond_worker.arrays import Int32
from precond_worker.symbolic.assembly_tree import AssemblyTree


@dataclass(frozen=True)
class CopiedPattern:
    """A tree of fronts and a block pattern, `count` times one after another."""

    tree: AssemblyTree
    row_start: Int32
    columns: Int32
    count: int


def copies(tree: AssemblyTree, row_start: Int32, columns: Int32, count: int) -> CopiedPattern:
    """Returns the pattern of a block diagonal matrix: `count` matrices of the given pattern, and their trees.

    Values of L of one matrix follow those of the one before, and so do its blocks.
    """
    nodes, fronts = len(tree.order), len(tree.parent)
    copy = np.arange(count)[:, None]
    return CopiedPattern(
        AssemblyTree(
            (tree.order + nodes * copy).ravel(),
            np.append((tree.first[:-1] + nodes * copy).ravel(), nodes * count),
            np.where(tree.parent < 0, -1, tree.parent + fronts * copy).ravel(),
            np.append((tree.below_start[:-1] + len(tree.below) * copy).ravel(), len(tree.below) * count),
            (tree.below + nodes * copy).ravel(),
        ),
        np.append((row_start[:-1] + len(columns) * copy).ravel(), len(columns) * count).astype(np.int32),
        (columns + nodes * copy).ravel().astype(np.int32),
        count,
    )
