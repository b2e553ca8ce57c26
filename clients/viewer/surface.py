# SPDX-License-Identifier: MIT
"""The surface of a mesh, or its skin: positions and normals of its points, and the scalar that colours them."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clients.log.frames import Mesh
from clients.log.von_mises import StressField

Coloring = Literal["displacement", "von_mises"]
LEGEND: dict[str, tuple[str, str]] = {"displacement": ("displacement", "m"), "von_mises": ("von Mises stress", "Pa")}


def legend(coloring: Coloring, top: float) -> str:
    """Words the scale of the colours; `top`: value of the last one."""
    title, unit = LEGEND[coloring]
    return f"{title}: 0 (violet) to {top:.3g} {unit} (yellow)"


class Surface:
    """Surface of one topology epoch: its skin if it has one, else the outer faces of the elements.

    nodes (s,): of the mesh that its points depend on, ascending; triangles (t, 3): of points
    """

    def __init__(self, mesh: Mesh, coloring: Coloring) -> None:
        self._skin = mesh.skin
        used = mesh.triangles if mesh.skin is None else mesh.skin.nodes
        self.nodes, inverse = np.unique(used, return_inverse=True)
        triangles = inverse.reshape(-1, 3) if mesh.skin is None else mesh.skin.triangles
        self.triangles = triangles.astype(np.uint32)
        self._rest = self._at_points(mesh.rest)
        self._stress: StressField | None = None
        self.elastic = len(mesh.young) > 0
        if coloring == "von_mises" and self.elastic:
            self._stress = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson, self.nodes)
        self._displacement = coloring == "displacement"

    def points(self, x: NDArray) -> NDArray[np.float32]:
        """Returns the positions (s, 3) [m] of the points, x: of all nodes."""
        return self._at_points(x).astype(np.float32)

    def values(self, x: NDArray) -> NDArray[np.float64]:
        """Returns the colouring scalar (s,): displacement from rest [m] or von Mises stress [Pa] (0 if not elastic)."""
        if not np.isfinite(x).all():
            return np.full(len(self._rest), np.nan)
        if self._displacement:
            return np.linalg.norm(self._at_points(x) - self._rest, axis=1)
        if self._stress is None:
            return np.zeros(len(self._rest))
        return np.maximum(self._at_points(self._stress.nodes(x)), 0.0)  # weights beyond the mesh may be negative

    def _at_points(self, nodal: NDArray) -> NDArray:
        """Returns what nodes have (n, ...) at the points."""
        return nodal[self.nodes] if self._skin is None else self._skin.values(nodal)

    def normals(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns unit normals (s, 3), weighted by the areas of the triangles."""
        a, b, c = (points[self.triangles[:, k]] for k in range(3))
        faces = np.cross(b - a, c - a)
        corner = self.triangles.ravel()
        total = np.stack([np.bincount(corner, np.repeat(faces[:, k], 3), len(points)) for k in range(3)], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.divide(total, length, out=np.zeros_like(total), where=length > 0).astype(np.float32)
