# SPDX-License-Identifier: MIT
"""Strain cells: parts of a mesh with one deformation gradient each, in patches that share one dilatation."""

from dataclasses import dataclass

from sim_server.arrays import Float64, Int32


@dataclass(frozen=True)
class StrainCells:
    """Cells of a body, each with F = sum_k x[nodes_k] (x) gradients_k over its nodes.

    start: int32 (m + 1,), where the nodes of each cell begin
    nodes: int32 (k,), body-local node numbers, cell after cell
    gradients: float64 (k, 3) [1/m]; sum to 0 in each cell
    volume: float64 (m,) [m3]; sums to the body's volume
    element: int32 (m,), a tetrahedron (row of Mesh.tets) whose material constants the cell has
    patch: int32 (m,), number of its patch, 0 to patches - 1, without gaps
    """

    start: Int32
    nodes: Int32
    gradients: Float64
    volume: Float64
    element: Int32
    patch: Int32

    @property
    def patches(self) -> int:
        """Number of patches."""
        return int(self.patch.max(initial=-1)) + 1
