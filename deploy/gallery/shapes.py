# SPDX-License-Identifier: MIT
"""The shapes of the gallery as signed distance functions [m], y up: rounded cones, ellipsoids, and smooth unions."""

from collections.abc import Sequence

import numpy as np

from deploy.gallery.mesher import Floats, Shape

Point = Sequence[float]


def cone(a: Point, b: Point, ra: float, rb: float) -> Shape:
    """A cone between two spheres: the distance from the segment a-b less a radius that changes along it."""
    start, along = np.array(a, float), np.subtract(b, a)

    def distance(x: Floats) -> Floats:
        t = np.clip((x - start) @ along / (along @ along), 0, 1)
        return np.linalg.norm(x - start - t[:, None] * along, axis=1) - ra - (rb - ra) * t

    return distance


def ellipsoid(centre: Point, radii: Point) -> Shape:
    """An ellipsoid, its distance to first order."""
    c, r = np.array(centre, float), np.array(radii, float)

    def distance(x: Floats) -> Floats:
        k, g = np.linalg.norm((x - c) / r, axis=1), np.linalg.norm((x - c) / r**2, axis=1)
        return k * (k - 1) / np.maximum(g, 1e-9)

    return distance


def chain(points: Sequence[Point], radii: Sequence[float], blend: float) -> Shape:
    """Cones from point to point."""
    ends = zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True)
    return union([cone(a, b, ra, rb) for a, b, ra, rb in ends], blend)


def union(parts: Sequence[Shape], blend: float) -> Shape:
    """The union of shapes; edges between them are filled over about `blend` [m]."""

    def distance(x: Floats) -> Floats:
        found = parts[0](x)
        for part in parts[1:]:
            other = part(x)
            h = np.maximum(blend - np.abs(found - other), 0) / blend
            found = np.minimum(found, other) - h**2 * blend / 4
        return found

    return distance


def mirrored(shape: Shape) -> Shape:
    """The shape at x > 0, and its image at x < 0."""
    return lambda x: shape(np.abs(x) * [1, 0, 0] + x * [0, 1, 1])


def below(shape: Shape, top: float, blend: float) -> Shape:
    """What of a shape is below y = top, its new edge rounded over about `blend` [m]."""
    return lambda x: -union([lambda p: -shape(p), lambda p: top - p[:, 1]], blend)(x)


def above_floor(shape: Shape, blend: float = 0.012) -> Shape:
    """What of a shape is above y = 0."""
    return lambda x: -union([lambda p: -shape(p), lambda p: p[:, 1]], blend)(x)


def creature() -> Shape:
    """A creature of 0.45 m that stands upright, faces z and stretches its arms out; it has horns and a tail."""
    body = union([ellipsoid((0, 0.17, 0), (0.075, 0.085, 0.07)), cone((0, 0.2, 0), (0, 0.28, 0), 0.06, 0.045)], 0.04)
    head = union([ellipsoid((0, 0.345, 0.01), (0.056, 0.05, 0.052)),
                  cone((0, 0.335, 0.04), (0, 0.325, 0.085), 0.032, 0.024)], 0.03)  # fmt: skip
    horn = mirrored(chain([(0.03, 0.37, 0), (0.062, 0.4, -0.005), (0.074, 0.44, 0)], [0.024, 0.02, 0.013], 0.01))
    arm = mirrored(chain([(0.045, 0.265, 0), (0.13, 0.25, 0.005), (0.205, 0.275, 0.03)], [0.032, 0.027, 0.023], 0.015))
    hand = mirrored(ellipsoid((0.225, 0.283, 0.038), (0.032, 0.03, 0.03)))
    leg = mirrored(cone((0.045, 0.14, 0), (0.065, 0.03, 0), 0.043, 0.034))
    foot = mirrored(cone((0.066, 0.02, -0.01), (0.075, 0.016, 0.055), 0.036, 0.028))
    tail = chain([(0, 0.13, -0.04), (0, 0.07, -0.115), (0, 0.06, -0.18), (0, 0.1, -0.235)],
                 [0.042, 0.033, 0.024, 0.016], 0.02)  # fmt: skip
    limbs = union([arm, leg, tail], 0.03)
    return above_floor(union([union([union([body, limbs], 0.035), head], 0.025), horn, hand, foot], 0.015))


def liver() -> Shape:
    """An organ of 0.24 m: a large right lobe at x < 0, a thin left one, a hollow below; four ligaments lead up."""
    right = ellipsoid((-0.045, 0, 0), (0.085, 0.045, 0.07))
    left = ellipsoid((0.06, 0.012, 0.01), (0.075, 0.026, 0.052))
    lobes = union([right, left, ellipsoid((-0.075, -0.02, 0.005), (0.05, 0.045, 0.055))], 0.04)
    hollow = ellipsoid((0.01, -0.055, 0.02), (0.03, 0.035, 0.05))

    def organ(x: Floats) -> Floats:
        a, b, k = lobes(x), -hollow(x), 0.02
        h = np.maximum(k - np.abs(a - b), 0) / k
        return np.maximum(a, b) + h**2 * k / 4

    cords = [cone(a, b, 0.012, 0.01) for a, b in LIGAMENTS]
    return below(union([organ, *cords], 0.014), TOP, 0.006)


TOP = 0.1  # where the ligaments end [m]
LIGAMENTS = (
    ((-0.095, 0.015, -0.03), (-0.11, TOP + 0.02, -0.045)),
    ((-0.06, 0.02, 0.035), (-0.06, TOP + 0.02, 0.05)),
    ((0, 0.02, -0.005), (0.01, TOP + 0.02, -0.015)),
    ((0.085, 0.015, 0.01), (0.1, TOP + 0.02, 0.005)),
)


def tentacle() -> Shape:
    """An arm of 0.5 m that rises from y = 0, leans over and curls inwards towards its tip."""
    points, radii, at, heading = [np.array([0.0, -0.03, 0.0])], [0.055], np.array([0.0, -0.03, 0.0]), 90.0
    pieces = 16
    for k in range(pieces):
        at = at + 0.66 / pieces * np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0])
        heading -= 2 + 1.9 * k
        points.append(at)
        radii.append(0.055 - 0.041 * (k + 1) / pieces)
    return above_floor(chain(points, radii, 0.01))


def jelly() -> Shape:
    """A jelly of 0.1 m from a ribbed mould, its flat side down."""

    def distance(x: Floats) -> Floats:
        angle, across = np.arctan2(x[:, 2], x[:, 0]), np.hypot(x[:, 0], x[:, 2])
        taper = 0.055 - 0.22 * x[:, 1]
        ribs = 0.004 * np.cos(8 * angle) * np.clip(across / 0.04, 0, 1)
        return np.asarray((across - taper - ribs) * 0.95)

    return above_floor(below(distance, 0.07, 0.03), 0.02)
