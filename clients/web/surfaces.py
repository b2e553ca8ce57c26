# SPDX-License-Identifier: MIT
"""The surfaces of all objects as one list of vertices and triangles, which follow the nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clients.log.frames import Mesh
from clients.web.decimate import decimated

MOST_VERTICES = 15_000  # that a browser shows 30 times a second
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """One object. Vertex k of it is the sum of weights[k, c] x[nodes[k, c]]."""

    mesh: Mesh
    first: int  # its first vertex in the scene's list
    nodes: NDArray[np.int32]  # (s, c)
    weights: Float64  # (s, c), sums 1

    @property
    def vertices(self) -> slice:
        """Its vertices in the scene's list."""
        return slice(self.first, self.first + len(self.nodes))

    def at(self, values: NDArray) -> Float64:
        """Returns at its vertices what is given at nodes: (n,) as (s,), (n, 3) as (s, 3)."""
        if self.nodes.shape[1] == 1:
            return values[self.nodes[:, 0]]
        return np.einsum("sc,sc...->s...", self.weights, values[self.nodes])


class Surfaces:
    """All surfaces. `points` (v, 3) float32 [m]: where the vertices are, `triangles` (t, 3) count in them."""

    def __init__(self, meshes: Mapping[str, Mesh], most: int = MOST_VERTICES) -> None:
        whole = {name: _surface(mesh) for name, mesh in meshes.items()}
        total = sum(len(nodes) for nodes, _, _ in whole.values())
        self._most = most
        self.full = total  # vertices before they were made fewer
        self.parts: dict[str, Part] = {}
        triangles, first = [np.zeros((0, 3), np.int32)], 0
        for name, mesh in meshes.items():
            nodes, weights, corners = whole[name]
            if total > most:
                rest = Part(mesh, 0, nodes, weights).at(mesh.rest)
                kept, corners = decimated(rest, corners, max(8, most * len(nodes) // total))
                nodes, weights = nodes[kept], weights[kept]
            self.parts[name] = Part(mesh, first, nodes, weights)
            triangles.append(corners + first)
            first += len(nodes)
        self.triangles: NDArray[np.int32] = np.concatenate(triangles).astype(np.int32)
        self.points = np.zeros((first, 3), np.float32)
        self.nodes = {name: mesh.rest for name, mesh in meshes.items()}  # newest positions of all nodes
        for name, mesh in meshes.items():
            self.move(name, mesh.rest)

    def move(self, name: str, x: Float64) -> bool:
        """Moves an object to the positions x (n, 3) [m]; False: it stays, as they do not fit or are not finite."""
        part = self.parts.get(name)
        if part is None or len(x) != len(part.mesh.rest) or not np.isfinite(x).all():
            return False
        self.nodes[name] = x
        self.points[part.vertices] = part.at(x)
        return True

    def cut(self, meshes: Mapping[str, Mesh]) -> Surfaces:
        """Returns the surfaces of these meshes, which have the same nodes, where the nodes are now."""
        found = Surfaces(meshes, self._most)
        for name, x in self.nodes.items():
            found.move(name, x)
        return found

    def take_moduli(self, meshes: Mapping[str, Mesh]) -> None:
        """Takes Young's moduli and Poisson's ratios of other meshes; all else stays."""
        for name, part in self.parts.items():
            new = meshes[name]
            mesh = replace(part.mesh, young=new.young, poisson=new.poisson)
            self.parts[name] = replace(part, mesh=mesh)

    def nearest(self, point: NDArray) -> tuple[str, int]:
        """Returns the object and the vertex that is nearest to a point [m]."""
        vertex = int(((self.points - point) ** 2).sum(axis=1).argmin())
        return next(name for name, part in self.parts.items() if vertex < part.vertices.stop), vertex

    def box(self) -> tuple[Float64, Float64]:
        """Returns the corners of a box around all vertices [m]."""
        if not len(self.points):
            return np.zeros(3), np.ones(3)
        return self.points.min(axis=0).astype(float), self.points.max(axis=0).astype(float)


def _surface(mesh: Mesh) -> tuple[NDArray[np.int32], Float64, NDArray[np.int32]]:
    """Returns nodes (s, c), weights (s, c) and triangles (t, 3) of the skin, or of the mesh's surface without one."""
    skin = getattr(mesh, "skin", None)
    if skin is not None:
        return skin.nodes, skin.weights, skin.triangles
    nodes, inverse = np.unique(mesh.triangles, return_inverse=True)
    return nodes[:, None].astype(np.int32), np.ones((len(nodes), 1)), inverse.reshape(-1, 3).astype(np.int32)
