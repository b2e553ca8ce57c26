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
FADING = 0.97  # factor of the end of a scale by one update, five of which come in a second
LEAST = 1e-5  # displacement over size, and strain of a stress, that the end of a scale has at least
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
        self._surfaces = surfaces
        self._top = self._least = _least(surfaces, mode)
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
        """Returns the band of each triangle (t,); the largest value of the last seconds has the last one.

        Of stress it is the 99th percentile, as it has no bound at corners and clamped edges.
        """
        if len(values):
            now = float(np.percentile(values, 99) if self.mode in _STEEP else values.max())
            self._top = max(now, FADING * self._top, self._least)
        self.legend = f"{self.mode}: 0 (violet) to {self._top:.3g} {UNITS[self.mode]} (yellow)"
        of = values[self._surfaces.triangles].mean(axis=1)
        return np.clip((of / (self._top or 1.0) * BANDS).astype(int), 0, BANDS - 1)

    def _constant_bands(self) -> tuple[NDArray[np.int64], Sequence[tuple[int, int, int]]] | None:
        """Returns bands (t,) and colours of a mode whose bands never change."""
        if self.mode == "plain":
            return np.zeros(len(self._surfaces.triangles), int), [PLAIN]
        if self.mode not in ("object", "material"):
            return None
        if self.mode == "object":
            values = np.zeros(len(self._surfaces.points), int)
            for number, part in enumerate(self._surfaces.parts.values()):
                values[part.vertices] = number % len(DISTINCT)
            return values[self._surfaces.triangles[:, 0]], DISTINCT
        return self._materials()

    def _materials(self) -> tuple[NDArray[np.int64], Sequence[tuple[int, int, int]]]:
        """Returns bands (t,) and colours by Young's modulus: a triangle has that of most of its vertices."""
        levels = _levels(self._surfaces)
        palette = [*(DISTINCT if len(levels) <= len(DISTINCT) else _VIRIDIS)[: len(levels)], GREY]
        self.legend = "Young's modulus [Pa]: " + ", ".join(f"{10**level:.3g}" for level in levels)
        number = np.full(len(self._surfaces.points), len(levels))
        for part in self._surfaces.parts.values():
            if len(part.mesh.young):
                number[part.vertices] = _material(part, levels)
            else:
                self.legend += "; grey: not elastic" if "grey" not in self.legend else ""
        return np.sort(number[self._surfaces.triangles], axis=1)[:, 1], palette


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


def _least(surfaces: Surfaces, mode: str) -> float:
    """Returns what the end of a scale is at least, so that what rests has one colour."""
    if mode == "displacement":
        return LEAST * max((float(np.ptp(p.mesh.rest, axis=0).max()) for p in surfaces.parts.values()), default=0.0)
    return LEAST * min((float(p.mesh.young.min()) for p in surfaces.parts.values() if len(p.mesh.young)), default=0.0)


def _material(part: Part, levels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the number of the level at each vertex (s,).

    It is that of the element in which the vertex of a skin lies, else of most of the elements around.
    """
    mesh = part.mesh
    of = np.abs(_log(mesh.young)[:, None] - levels).argmin(axis=1)
    votes = np.zeros((len(mesh.rest), len(levels)))
    np.add.at(votes, (mesh.tets.ravel(), np.repeat(of, 4)), 1)
    found = part.at(votes).argmax(axis=1)
    if part.nodes.shape[1] == 4:
        both = np.sort(np.concatenate([mesh.tets, part.nodes]), axis=1)
        _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
        element = first[inverse.reshape(-1)[len(of) :]]
        inside = element < len(of)
        found[inside] = of[element[inside]]
    return found


def _log(young: NDArray) -> NDArray[np.float64]:
    return np.log10(np.maximum(young.astype(float), 1e-30))


def _levels(surfaces: Surfaces) -> NDArray[np.float64]:
    """Returns the logarithms of Young's moduli that there are, or BANDS even ones between the extremes of many."""
    young = np.concatenate(
        [np.unique(p.mesh.young) for p in surfaces.parts.values() if len(p.mesh.young)] or [np.ones(1, np.float32)]
    )
    levels = np.unique(np.round(_log(young), 3))
    return levels if len(levels) <= BANDS else np.linspace(levels[0], levels[-1], BANDS)
