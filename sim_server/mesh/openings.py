# SPDX-License-Identifier: MIT
"""Openings of a part of a surface."""

import numpy as np
from numpy.typing import NDArray

from sim_server.errors import InputError


def openings(triangles: NDArray[np.integer]) -> list[list[int]]:
    """Returns the loops of nodes around the openings of oriented triangles (t, 3); none for a closed surface.

    A loop goes around its opening as the triangles at its edges do. Raises InputError for openings that meet at a node.
    """
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    balance: dict[tuple[int, int], int] = {}
    for a, b in edges.tolist():
        if balance.get((b, a), 0) > 0:
            balance[b, a] -= 1
        else:
            balance[a, b] = balance.get((a, b), 0) + 1
    after: dict[int, int] = {}
    for (a, b), count in balance.items():
        if count and (count > 1 or a in after):
            raise InputError(f"its openings meet at node {a}")
        if count:
            after[a] = b
    loops = []
    while after:
        first, node = after.popitem()
        loop = [first]
        while node != first:
            loop.append(node)
            node = after.pop(node)
        loops.append(loop)
    return loops
