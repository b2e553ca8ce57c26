# SPDX-License-Identifier: MIT
"""Nodes that may move along some directions only: rollers and planes of symmetry.

A node i keeps its place along the unit vectors n of its own, which stay what they are while the body moves. With
S_i = I - sum n n^T the condition is dv_i = S_i dv_i, and the system becomes

    A_ij <- S_i A_ij S_j,    A_ii <- S_i A_ii S_i + s_i (I - S_i),    b_i <- S_i b_i

in the world frame, with s_i > 0 of the size of the block: A stays symmetric positive definite, and the solution is in
the range of S (a projective constraint; Baraff and Witkin 1998, section 5.3). A node with three such directions is a
fixed one (effects/fixed.py).

The frame R_i of such a node turns about one axis alone, the normal of its plane or the line along which it may move: of
the rotations about it, it has the one nearest to the mean of the elements' rotations. So R_i^T S_i R_i = S_i at all
times, and in the material frame the directions of a factor are those of the matrix, however old it is: no
preconditioner takes a velocity out of the range of S, and a factor that stands in for the matrix does not, either.

What is kept is zero exactly along the axes x, y, z, and to rounding along others.
"""

from collections.abc import Sequence

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Backend, Launch

TEXT = "kernels/rollers.cu"
PARALLEL = 1e-6  # sine of the angle below which two directions count as one


class Rollers:
    """The nodes of a scene that may move along some directions only, and the launches that see to it.

    directions: by node of the scene, orthonormal rows (1 or 2, 3) along which it keeps its place
    nodes: number of all nodes

    allowed (nodes, 6): upper triangle of S; axis (nodes, 3): about which alone the frame turns, 0 at other nodes;
    limited (nodes,): 1 at the nodes with directions
    """

    def __init__(self, directions: dict[int, Float64], nodes: int, backend: Backend):
        self.directions, self._backend = directions, backend
        self.allowed, self.axis = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (nodes, 1)), np.zeros((nodes, 3))
        self.limited = np.zeros(nodes, np.int32)
        for node, normals in directions.items():
            axis = normals[0] if len(normals) == 1 else np.cross(*normals)
            plane = np.outer(axis, axis)
            projection = np.eye(3) - plane if len(normals) == 1 else plane
            self.allowed[node] = projection[np.triu_indices(3)]
            self.axis[node], self.limited[node] = axis, 1
        backend.keep(self.allowed, self.axis, self.limited)

    def keep_force(self, b: Float64) -> Launch:
        """Takes b (nodes, 3) to the directions in which nodes may move."""
        return self._nodal("keep_force", allowed=self.allowed, b=b)

    def keep_frame(self, mean: Float64) -> Launch:
        """Has the sums of rotations `mean` (nodes, 10) make frames that turn about the nodes' axes."""
        return self._nodal("keep_frame", axis=self.axis, mean=mean)

    def keep_matrix(self, block: Float64, sums: Float64, row: Int32, column: Int32) -> list[Launch]:
        """Takes the nodes' own blocks (nodes, 6) and those above the diagonal to the allowed directions."""
        own = self._nodal("keep_block", allowed=self.allowed, axis=self.axis, block=block)
        others: Launch = self._backend.module("kernels/roller_blocks.cu").bind(
            "keep_blocks", len(row), row=row, column=column, limited=self.limited, allowed=self.allowed, sums=sums
        )
        return [own, others]

    def _nodal(self, kernel: str, **arguments: Float64) -> Launch:
        launch: Launch = self._backend.module(TEXT).bind(kernel, len(self.axis), **arguments)
        return launch


def span_of(vectors: Sequence[Float64]) -> Float64:
    """Returns an orthonormal basis (k, 3) of what the vectors (3,) span; nearly parallel ones count as one."""
    basis: list[Float64] = []
    for vector in vectors:
        rest = vector / np.linalg.norm(vector)
        for _ in range(2):  # twice: orthogonal to rounding
            for known in basis:
                rest = rest - (rest @ known) * known
        size = float(np.linalg.norm(rest))
        if size > PARALLEL and len(basis) < 3:
            basis.append(rest / size)
    return np.array(basis).reshape(-1, 3)
