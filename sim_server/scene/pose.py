# SPDX-License-Identifier: MIT
"""Poses of objects and obstacles."""

from collections.abc import Sequence
from math import cos, radians, sin

import numpy as np
from pydantic import Field

from sim_server.arrays import Float64
from sim_server.scene.parameters import Parameters, Vector


class Pose(Parameters):
    """Rotation about the fixed axes x, then y, then z, followed by a translation."""

    rotate: Vector = Field(default=(0.0, 0.0, 0.0), description="angles [degrees]")
    translate: Vector = Field(default=(0.0, 0.0, 0.0), description="displacement, after the rotation [m]")


def quaternion(rotate: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns the unit quaternion w, x, y, z of `Pose.rotate`."""
    (a, b, c), (p, q, r) = ([f(radians(angle) / 2) for angle in rotate] for f in (cos, sin))
    return (
        a * b * c + p * q * r, p * b * c - a * q * r, a * q * c + p * b * r, a * b * r - p * q * c,
    )  # fmt: skip


def turned(points: Float64, rotation: Float64) -> Float64:
    """Returns points (n, 3) turned by a unit quaternion w, x, y, z."""
    w, axis = rotation[0], rotation[1:]
    across = 2 * np.cross(axis, points)
    return np.asarray(points + w * across + np.cross(axis, across))
