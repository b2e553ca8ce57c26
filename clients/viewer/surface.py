# SPDX-License-Identifier: MIT
"""The surface of a mesh: its nodes, their positions and normals, and the scalar that colours them."""

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
    """Surface of one topology epoch. `nodes` (s,) are the mesh's numbers of the surface nodes, ascending;
    `triangles` (t, 3) count in them."""

    def __init__(self, mesh: Mesh, coloring: Coloring) -> None:
        self.nodes, inverse = np.unique(mesh.triangles, return_inverse=True)
        self.triangles = inverse.reshape(-1, 3).astype(np.uint32)
        self._rest = mesh.rest[self.nodes]
        self._stress: StressField | None = None
        self.elastic = len(mesh.young) > 0
        if coloring == "von_mises" and self.elastic:
            self._stress = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson, self.nodes)
        self._displacement = coloring == "displacement"

    def points(self, x: NDArray) -> NDArray[np.float32]:
        """Returns the positions (s, 3) [m] of the surface nodes, x: of all nodes."""
        return x[self.nodes].astype(np.float32)

    def values(self, x: NDArray) -> NDArray[np.float64]:
        """Returns the colouring scalar (s,): displacement from rest [m] or von Mises stress [Pa] (0 if not elastic)."""
        if not np.isfinite(x).all():
            return np.full(len(self.nodes), np.nan)
        if self._displacement:
            return np.linalg.norm(x[self.nodes] - self._rest, axis=1)
        return self._stress.nodes(x)[self.nodes] if self._stress else np.zeros(len(self.nodes))

    def normals(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns unit normals (s, 3), weighted by the areas of the triangles."""
        a, b, c = (points[self.triangles[:, k]] for k in range(3))
        faces = np.cross(b - a, c - a)
        corner = self.triangles.ravel()
        total = np.stack([np.bincount(corner, np.repeat(faces[:, k], 3), len(points)) for k in range(3)], axis=1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.divide(total, length, out=np.zeros_like(total), where=length > 0).astype(np.float32)
