# SPDX-License-Identifier: MIT
"""Bodies made of shapes, by their signed distances: `mesh = { sdf = ..., edge = ... }`."""

from functools import reduce
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from sim_server.arrays import Float64
from sim_server.scene.parameters import NotNegative, Parameters, Positive, Sizes, Vector, complaint

KINDS = ("sphere", "box", "capsule", "union")
DEEPEST = 20  # unions in unions
Bounds = tuple[Float64, Float64]


class Part(Protocol):
    """A shape. All lengths are in m."""

    def distances(self, points: Float64) -> Float64:
        """Returns the distance of points (k, 3) from its surface, below 0 inside, (k,)."""

    def bounds(self) -> Bounds:
        """Returns the corners of a box around it, (3,) each."""


class Sphere(Parameters):
    radius: Positive = Field(description="distance of the surface from the middle [m]")
    center: Vector = Field(default=(0.0, 0.0, 0.0), description="the middle [m]")

    def distances(self, points: Float64) -> Float64:
        return np.asarray(np.linalg.norm(points - self.center, axis=1) - self.radius)

    def bounds(self) -> Bounds:
        return np.array(self.center) - self.radius, np.array(self.center) + self.radius


class Box(Parameters):
    """A box along the axes; round: radius of its edges and corners."""

    size: Sizes = Field(description="along x, y, z [m]")
    center: Vector = Field(default=(0.0, 0.0, 0.0), description="the middle [m]")
    round: NotNegative = Field(default=0.0, description="radius of its edges [m]")

    @model_validator(mode="after")
    def _fits(self) -> "Box":
        if 2 * self.round > min(self.size):
            raise complaint(f"round = {self.round:g} m: at most half the least size, {min(self.size) / 2:g} m")
        return self

    def distances(self, points: Float64) -> Float64:
        beyond = abs(points - self.center) - (np.array(self.size) / 2 - self.round)
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0) - self.round)

    def bounds(self) -> Bounds:
        return np.array(self.center) - np.array(self.size) / 2, np.array(self.center) + np.array(self.size) / 2


class Capsule(Parameters):
    """All points within a radius of a segment."""

    begin: Vector = Field(description="first end of the segment [m]")
    end: Vector = Field(description="second end of the segment [m]")
    radius: Positive = Field(description="distance of the surface from the segment [m]")

    def distances(self, points: Float64) -> Float64:
        begin, along = np.array(self.begin), np.array(self.end) - self.begin
        part = np.clip((points - begin) @ along / max(float(along @ along), 1e-300), 0, 1)
        return np.asarray(np.linalg.norm(points - begin - part[:, None] * along, axis=1) - self.radius)

    def bounds(self) -> Bounds:
        ends = np.array([self.begin, self.end])
        return ends.min(axis=0) - self.radius, ends.max(axis=0) + self.radius


class Shape(Parameters):
    """One of sphere, box, capsule and union; smooth: how far from where parts of a union meet they are blended."""

    sphere: Sphere | None = Field(default=None, description="a sphere")
    box: Box | None = None
    capsule: Capsule | None = None
    union: Annotated[list["Shape"], Field(min_length=1, max_length=1000)] | None = None
    smooth: NotNegative = Field(default=0.0, description="of a union: distance within which its parts blend [m]")

    @model_validator(mode="after")
    def _one_kind(self) -> "Shape":
        given = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise complaint(f"must be one of {', '.join(KINDS)}, not {' and '.join(given) or 'none'}")
        if self.smooth and self.union is None:
            raise complaint("smooth belongs to a union")
        return self

    @property
    def depth(self) -> int:
        """Unions in unions."""
        return 1 + max(part.depth for part in self.union) if self.union else 0

    def distances(self, points: Float64) -> Float64:
        """Returns the distance of points (k, 3) from the surface, below 0 inside, (k,) [m].

        That of a union is exact outside without `smooth`; with it min(a, b) - h^2 / (4 smooth), where
        h = max(smooth - |a - b|, 0), one part after the other (Quilez, Smooth minimum, 2013).
        """
        if self.union is None:
            return self._part.distances(points)
        given = [part.distances(points) for part in self.union]
        return reduce(self._joined, given)

    def bounds(self) -> Bounds:
        """Returns the corners of a box around it, (3,) each [m]."""
        if self.union is None:
            return self._part.bounds()
        boxes = [part.bounds() for part in self.union]
        more = self.smooth / 4 * (len(boxes) - 1)
        return np.min([low for low, _ in boxes], axis=0) - more, np.max([high for _, high in boxes], axis=0) + more

    @property
    def _part(self) -> Part:
        part: Any = self.sphere or self.box or self.capsule
        return part  # type: ignore[no-any-return]

    def _joined(self, a: Float64, b: Float64) -> Float64:
        nearest: Float64 = np.minimum(a, b)
        if self.smooth:
            nearest -= np.maximum(self.smooth - abs(a - b), 0) ** 2 / (4 * self.smooth)
        return nearest


def _not_too_deep(shape: Shape) -> Shape:
    if shape.depth > DEEPEST:
        raise complaint(f"{shape.depth} unions in each other; allowed: {DEEPEST}")
    return shape


Sdf = Annotated[Shape, AfterValidator(_not_too_deep)]
