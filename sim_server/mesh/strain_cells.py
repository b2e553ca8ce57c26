# SPDX-License-Identifier: MIT
"""Strain cells: parts of a mesh with one deformation gradient each, in patches that share one dilatation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64

DEVIATOR, DILATATION = 1, 2  # what a cell counts for; their sum: both
WINDOW = 256  # cells among which those of as many nodes come together, so that they fill the same slices


@dataclass(frozen=True)
class StrainCells:
    """Cells of a body, each with F = sum_k x[nodes_k] (x) gradients_k over its nodes.

    start: int32 (m + 1,), where the nodes of each cell begin
    nodes: int32 (k,), body-local node numbers, cell after cell
    gradients: float64 (k, 3) [1/m]; sum to 0 in each cell
    volume: float64 (m,) [m3]; of the cells of each role it sums to the body's volume
    element: int32 (m,), a tetrahedron (row of Mesh.tets) whose material constants the cell has
    patch: int32 (m,), number of its patch, 0 to patches - 1, without gaps
    role: int32 (m,), DEVIATOR where the cell has that strain alone, DILATATION where only the mean dilatation of the
        patch is taken from it; None: every cell has both
    """

    start: Int32
    nodes: Int32
    gradients: Float64
    volume: Float64
    element: Int32
    patch: Int32
    role: Int32 | None = None

    @property
    def patches(self) -> int:
        """Number of patches."""
        return int(self.patch.max(initial=-1)) + 1

    def has(self, role: int) -> NDArray[np.bool_]:
        """Whether each cell counts for DEVIATOR or for DILATATION, (m,)."""
        return np.ones(len(self.volume), bool) if self.role is None else (self.role & role) > 0

    def in_order(self) -> "StrainCells":
        """Returns the same with cells patch after patch, in each window sorted by their number of nodes."""
        by_patch = np.argsort(self.patch, kind="stable")
        window = np.arange(len(by_patch)) // WINDOW
        return self.rearranged(by_patch[np.lexsort((-np.diff(self.start)[by_patch], window))])

    def rearranged(self, order: Int64) -> "StrainCells":
        """Returns the same with cells in another order. order (m,): their numbers here."""
        sizes = np.diff(self.start)[order]
        start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        rows = np.arange(start[-1]) + np.repeat(self.start[:-1][order] - start[:-1], sizes)
        return StrainCells(
            start, self.nodes[rows], self.gradients[rows], self.volume[order], self.element[order], self.patch[order],
            None if self.role is None else self.role[order],
        )  # fmt: skip


def joined(parts: Sequence[StrainCells], bodies: Sequence[tuple[int, int]]) -> StrainCells:
    """Returns the cells of several bodies as one.

    bodies: first node and number of tetrahedra of each, of which the numbers of nodes and tetrahedra follow
    """
    counts = [[len(p.nodes), tets, p.patches] for p, (_, tets) in zip(parts, bodies, strict=True)]
    before = np.cumsum([[0, 0, 0], *counts], axis=0)
    numbers = list(zip(parts, bodies, before.astype(np.int32), strict=False))
    start = np.concatenate([np.zeros(1, np.int32), *(p.start[1:] + n[0] for p, _, n in numbers)])
    return StrainCells(
        start.astype(np.int32),
        np.concatenate([p.nodes + np.int32(first) for p, (first, _), _ in numbers]),
        np.concatenate([p.gradients for p in parts]),
        np.concatenate([p.volume for p in parts]),
        np.concatenate([p.element + n[1] for p, _, n in numbers]),
        np.concatenate([p.patch + n[2] for p, _, n in numbers]),
        np.concatenate([(p.has(DEVIATOR) + 2 * p.has(DILATATION)).astype(np.int32) for p in parts]),
    )
