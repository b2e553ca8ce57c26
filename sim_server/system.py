# SPDX-License-Identifier: MIT
"""The linear system of a step: arrays of A' and b', their pattern, and who adds what where.

A is block CSR with 3x3 blocks over all nodes of the scene, both triangles, columns ascending; bodies do not couple, so
a body's blocks are one range of it. Rows of fixed nodes hold their diagonal block alone (the identity). Effects add to
    b (n, 3) [N s], diagonal (n,) [kg] and sums (upper blocks, 3, 3) [kg], all in the world frame;
`turn` and `assemble` then take b and A into the material frame, where the solve happens (kernels/assemble.cu).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_server.backend import Launch
from sim_server.world import World

Ints = NDArray[np.int32]


@dataclass(frozen=True)
class Stencil:
    """Where the elements of an effect stand in the system.

    corner_start (nodes + 1,), corners: slots 4 e + a of the elements at each node.
    pair_start (upper blocks + 1,), pairs (k, 2): slots of the corners that couple in each block.
    """

    corner_start: Ints
    corners: Ints
    pair_start: Ints
    pairs: Ints


class System:
    """Pattern and arrays of A' and b' for a world and the elements of its effects.

    tets: per effect, (m, 4) node numbers of the elements that couple their corners.
    """

    def __init__(self, world: World, tets: list[Ints], warped: NDArray[np.float64]):
        n = world.nodes
        self.world, self.warped = world, warped
        keys = [_couplings(t, world.free, n)[0] for t in tets]
        diagonal = np.arange(n, dtype=np.int64) * (n + 1)
        upper = np.unique(np.concatenate([diagonal, *keys]))
        self.row, self.column = (part.astype(np.int32) for part in np.divmod(upper, n))
        self._number(n)
        self.stencils = [_stencil(t, world.free, n, upper) for t in tets]

        self.sums = np.zeros((len(upper), 3, 3))
        self.values = np.zeros((len(self.columns), 3, 3))
        self.diagonal = np.zeros(n)
        self.diagonal_block = np.flatnonzero(self.row == self.column).astype(np.int32)  # of each node, among the sums
        self.b = np.zeros((n, 3))
        self.mean = np.zeros((n, 3, 3))
        self.rotation = np.tile(np.eye(3), (n, 1, 1))
        self.b_material = np.zeros((n, 3))
        self.y = np.zeros((n, 3))
        self.dv = np.zeros((n, 3))
        self.clock = np.zeros(1)
        world.backend.keep(*(a for o in (world, self) for a in vars(o).values() if isinstance(a, np.ndarray)))

    def _number(self, n: int) -> None:
        """Places of the upper blocks and of their transposes in block CSR."""
        off = self.row != self.column
        rows = np.concatenate([self.row, self.column[off]])
        columns = np.concatenate([self.column, self.row[off]])
        order = np.lexsort((columns, rows))
        place = np.empty(len(order), dtype=np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        self.columns: Ints = columns[order].astype(np.int32)
        self.row_start: Ints = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))]).astype(np.int32)
        self.upper: Ints = place[: len(self.row)].copy()
        self.lower: Ints = self.upper.copy()
        self.lower[off] = place[len(self.row) :]

    def start(self) -> Launch:
        """b = 0, diagonal = mass."""
        return self.world.backend.module("kernels/nodes.cu").bind(
            "start", self.world.nodes, mass=self.world.mass, diagonal=self.diagonal, b=self.b, mean=self.mean
        )

    def finish(self) -> list[Launch]:
        """Everything into the material frame: A' = R^T A R, b' = R^T b, and the start of the solve."""
        w, free = self.world, self.world.free
        turn = self.world.backend.module("kernels/nodes.cu").bind(
            "turn", w.nodes, free=free, warped=self.warped, mean=self.mean, b=self.b, dv=self.dv,
            rotation=self.rotation, b_material=self.b_material, y=self.y,
        )  # fmt: skip
        assemble = self.world.backend.module("kernels/assemble.cu").bind(
            "assemble", len(self.row), row=self.row, column=self.column, upper=self.upper, lower=self.lower, free=free,
            diagonal=self.diagonal, sums=self.sums, rotation=self.rotation, values=self.values,
        )  # fmt: skip
        return [turn, assemble]

    def advance(self) -> Launch:
        """v += R y, x += h v."""
        w = self.world
        return self.world.backend.module("kernels/nodes.cu").bind(
            "advance", w.nodes, rotation=self.rotation, y=self.y, h=w.dt, dv=self.dv, v=w.v, x=w.x
        )

    def body_pattern(self, first: int, last: int) -> tuple[Ints, Ints]:
        """row_start and columns of one body, numbered from 0."""
        start = self.row_start[first : last + 1]
        return (start - start[0]).astype(np.int32), (self.columns[start[0] : start[-1]] - first).astype(np.int32)

    def body_values(self, first: int, last: int) -> NDArray[np.float64]:
        """View of the blocks of one body, (blocks, 3, 3)."""
        return self.values[self.row_start[first] : self.row_start[last]]


def _couplings(tets: Ints, free: NDArray[np.float64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Key row * n + column and slot pair of every coupling on or above the diagonal between free corners."""
    keys, pairs = [], []
    element = 4 * np.arange(len(tets), dtype=np.int64)
    for a in range(4):
        for b in range(4):
            i, j = tets[:, a].astype(np.int64), tets[:, b].astype(np.int64)
            here = (i <= j) & (free[i] > 0) & (free[j] > 0)
            keys.append((i * n + j)[here])
            pairs.append(np.stack([element + a, element + b], axis=1)[here])
    return np.concatenate(keys), np.concatenate(pairs)


def _stencil(tets: Ints, free: NDArray[np.float64], n: int, upper: NDArray[np.int64]) -> Stencil:
    corners = np.argsort(tets.ravel(), kind="stable").astype(np.int32)
    corner_start = np.concatenate([[0], np.cumsum(np.bincount(tets.ravel(), minlength=n))]).astype(np.int32)
    keys, pairs = _couplings(tets, free, n)
    block = np.searchsorted(upper, keys)
    order = np.argsort(block, kind="stable")
    pair_start = np.concatenate([[0], np.cumsum(np.bincount(block, minlength=len(upper)))]).astype(np.int32)
    return Stencil(corner_start, corners, pair_start, pairs[order].astype(np.int32))
