# SPDX-License-Identifier: MIT
"""Colours of the surface: which triangles have which of a few colours.

viser's meshes have one colour each, so a coloured surface is one mesh for each band of values. Bands change a few times
a second, positions with each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.log.von_mises import StressField
from clients.viewer.colors import colors
from clients.web.surfaces import Part, Surfaces

BANDS = 12
MODES = ("displacement", "von Mises stress", "material", "object", "plain")
UNITS = {"displacement": "m", "von Mises stress": "Pa"}
PLAIN = (224, 140, 110)
GREY = (150, 150, 150)
# Of objects and materials, distinct also to people who see some colours alike: Wong, Nature Methods 8 (2011) 441.
DISTINCT = (
    (86, 180, 233), (230, 159, 0), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167),
)  # fmt: skip


@dataclass(frozen=True)
class Band:
    """Triangles of one colour: vertices (s,) of the scene's list, triangles (t, 3) that count in them."""

    color: tuple[int, int, int]
    vertices: NDArray[np.int64]
    triangles: NDArray[np.uint32]


class Paint:
    """Bands of one mode. `version` grows whenever they change; `legend` words their scale."""

    def __init__(self, surfaces: Surfaces, mode: str) -> None:
        self.mode, self.version, self.legend = mode, 0, ""
        self.smooth = mode in ("plain", "object")  # shaded across edges: bands would show as creases
        self._surfaces, self._top = surfaces, 0.0
        self._stress = _stress_fields(surfaces) if mode == "von Mises stress" else {}
        self.bands: list[Band] = []
        self._band = np.full(len(surfaces.triangles), -1)
        self._fixed = self._constant_bands()
        self.update()

    def update(self) -> None:
        """Colours the surface as it is now."""
        if self._fixed is not None:
            band, palette = self._fixed
        else:
            band, palette = self._banded(self._values()), _VIRIDIS
        if np.array_equal(band, self._band):
            return
        self._band = band
        self.bands = split(self._surfaces.triangles, band, palette)
        self.version += 1

    def _values(self) -> NDArray[np.float64]:
        """Returns the scalar at each vertex (v,)."""
        values = np.zeros(len(self._surfaces.points))
        for name, part in self._surfaces.parts.items():
            x = self._surfaces.nodes[name]
            if self.mode == "displacement":
                values[part.vertices] = np.linalg.norm(part.at(x - part.mesh.rest), axis=1)
            elif name in self._stress:
                values[part.vertices] = part.at(self._stress[name].nodes(x))
        return values

    def _banded(self, values: NDArray) -> NDArray[np.int64]:
        """Returns the band of each triangle (t,); the largest value so far has the last one.

        Of stress it is the 99th percentile, as it has no bound at corners and clamped edges.
        """
        if len(values):
            self._top = max(self._top, float(np.percentile(values, 99) if self.mode in _STEEP else values.max()))
        self.legend = f"{self.mode}: 0 (violet) to {self._top:.3g} {UNITS[self.mode]} (yellow)"
        of = values[self._surfaces.triangles].mean(axis=1)
        return np.clip((of / (self._top or 1.0) * BANDS).astype(int), 0, BANDS - 1)

    def _constant_bands(self) -> tuple[NDArray[np.int64], Sequence[tuple[int, int, int]]] | None:
        """Returns bands (t,) and colours of a mode whose bands never change."""
        if self.mode == "plain":
            return np.zeros(len(self._surfaces.triangles), int), [PLAIN]
        if self.mode not in ("object", "material"):
            return None
        values = np.zeros(len(self._surfaces.points))
        if self.mode == "object":
            for number, part in enumerate(self._surfaces.parts.values()):
                values[part.vertices] = number % len(DISTINCT)
            return values[self._surfaces.triangles[:, 0]].astype(int), DISTINCT
        for part in self._surfaces.parts.values():
            values[part.vertices] = part.at(_log_young(part))
        levels = _levels(self._surfaces)
        self.legend = "Young's modulus [Pa]: " + ", ".join(f"{10**level:.3g}" for level in levels)
        of = values[self._surfaces.triangles].mean(axis=1)
        band = np.abs(of[:, None] - levels).argmin(axis=1)
        return band, DISTINCT if len(levels) <= len(DISTINCT) else _VIRIDIS


_VIRIDIS = [(int(r), int(g), int(b)) for r, g, b, _ in colors(np.linspace(0.0, 1.0, BANDS), 1.0)]
_STEEP = ("von Mises stress",)


def split(triangles: NDArray, band: NDArray, palette: Sequence[tuple[int, int, int]]) -> list[Band]:
    """Sorts triangles (t, 3) by their band (t,); those of bands without triangles are empty."""
    found = []
    for number, color in enumerate(palette):
        vertices, inverse = np.unique(triangles[band == number], return_inverse=True)
        found.append(Band(color, vertices, inverse.reshape(-1, 3).astype(np.uint32)))
    return found


def _stress_fields(surfaces: Surfaces) -> dict[str, StressField]:
    fields = {}
    for name, part in surfaces.parts.items():
        mesh = part.mesh
        if len(mesh.young):
            fields[name] = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson, np.unique(part.nodes))
    return fields


def _log_young(part: Part) -> NDArray[np.float64]:
    """Returns the mean logarithm of the Young's moduli [Pa] around each node (n,); 0 where it is not elastic."""
    mesh = part.mesh
    if not len(mesh.young):
        return np.zeros(len(mesh.rest))
    logs = np.log10(np.maximum(mesh.young.astype(float), 1e-30))
    count = np.bincount(mesh.tets.ravel(), minlength=len(mesh.rest))
    total = np.bincount(mesh.tets.ravel(), np.repeat(logs, 4), len(mesh.rest))
    return np.divide(total, count, out=np.zeros(len(total)), where=count > 0)


def _levels(surfaces: Surfaces) -> NDArray[np.float64]:
    """Returns the logarithms of Young's moduli that there are, or BANDS even ones between the extremes of many."""
    young = np.concatenate(
        [np.unique(p.mesh.young) for p in surfaces.parts.values() if len(p.mesh.young)] or [np.ones(1, np.float32)]
    )
    levels = np.unique(np.round(np.log10(np.maximum(young.astype(float), 1e-30)), 3))
    return levels if len(levels) <= BANDS else np.linspace(levels[0], levels[-1], BANDS)
