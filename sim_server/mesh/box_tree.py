# SPDX-License-Identifier: MIT
"""Trees of boxes over triangles: made once; the boxes are fitted to the triangles wherever they are."""

import numpy as np

from sim_server.arrays import Float64, Int32


def box_tree(centres: Float64) -> Int32:
    """Returns the children of each box, (2 m - 1, 2), of a tree over m triangles (m at least 1).

    centres: (m, 3). A box has two boxes that come after it, or one triangle k: ~k, twice. Boxes are halved at the
    median of the longest side of the box around their centres, so the tree is at most log2(m) + 1 high.
    """
    children: list[list[int]] = [[0, 0]]
    waiting = [(0, np.arange(len(centres)))]
    while waiting:
        box, inside = waiting.pop()
        if len(inside) == 1:
            children[box] = [~int(inside[0])] * 2
            continue
        axis = int(np.ptp(centres[inside], axis=0).argmax())
        order = inside[np.argsort(centres[inside, axis], kind="stable")]
        half = len(order) // 2
        children[box] = [len(children), len(children) + 1]
        waiting += [(len(children), order[:half]), (len(children) + 1, order[half:])]
        children += [[0, 0], [0, 0]]
    return np.array(children, np.int32)
