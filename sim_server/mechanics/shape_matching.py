# SPDX-License-Identifier: MIT
"""Rotations of nodes by shape matching, for the warp of bodies whose elements have none of their own.

The rotation of node i is the one nearest to::

    A_i = sum_j m_j (x_j - x_c) (X_j - X_c)^T

over i and its neighbours j, X at rest and x now, X_c and x_c their centres of mass (Müller, Heidelberger, Teschner and
Gross, Meshless Deformations Based on Shape Matching, 2005; Courtecuisse et al. 2010, section 6). Neighbours of level 1
share an element with i, those of level 2 one with a neighbour of level 1.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.mechanics.world import Body, World


class ShapeMatching:
    """Shape matching of some bodies.

    start (nodes + 1,), neighbour (k,): neighbours of each node, none at nodes of other bodies
    arm (k, 3): m_j (X_j - X_c), scaled so that the trace of A_i at rest is 1
    """

    def __init__(self, world: World, bodies: Sequence[Body], level: int):
        self.world = world
        tets = np.concatenate([body.tets for body in bodies])
        self.start, self.neighbour = neighbours(tets, world.nodes, level)
        self.arm = _arms(world.rest, world.uncut_mass, self.start, self.neighbour)

    def launch(self, mean: Float64) -> Launch:
        """Launch that writes A_i in place of the sum of rotations `mean` (n, 10) at the bodies' nodes."""
        return self.world.backend.module("kernels/shape_matching.cu").bind(
            "match", self.world.nodes, start=self.start, neighbour=self.neighbour, arm=self.arm, x=self.world.x,
            mean=mean,
        )  # fmt: skip


def neighbours(tets: Int32, nodes: int, level: int) -> tuple[Int32, Int32]:
    """Returns start (nodes + 1,) and the neighbours of each node up to `level`, ascending, without the node itself."""
    from scipy.sparse import coo_array

    one = np.ones(tets.size, bool)
    element = np.repeat(np.arange(len(tets)), 4)
    touching: Any = coo_array((one, (tets.ravel(), element)), shape=(nodes, len(tets))).tocsr()
    beside = touching @ touching.T
    reached = beside
    for _ in range(level - 1):
        reached = reached @ beside
    reached.sort_indices()
    row = np.repeat(np.arange(nodes), np.diff(reached.indptr))
    others = reached.indices != row
    start = np.concatenate([[0], np.cumsum(np.bincount(row[others], minlength=nodes))])
    return start.astype(np.int32), reached.indices[others].astype(np.int32)


def _arms(rest: Float64, mass: Float64, start: Int32, neighbour: Int32) -> Float64:
    """Returns the scaled arms (k, 3) of ShapeMatching."""
    n = len(rest)
    node = np.repeat(np.arange(n), np.diff(start))
    offset = rest[neighbour] - rest[node]  # relative to the node: no cancellation far from the origin
    weight = mass[neighbour]
    total = mass + np.bincount(node, weights=weight, minlength=n)
    centre = np.stack([np.bincount(node, weights=weight * o, minlength=n) for o in offset.T], axis=1) / total[:, None]
    arm = weight[:, None] * (offset - centre[node])
    trace = np.bincount(node, weights=(arm * offset).sum(axis=1), minlength=n)
    return np.ascontiguousarray(arm / trace[node][:, None])
