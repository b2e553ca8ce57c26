# SPDX-License-Identifier: MIT
"""Where the camera stands at first."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DISTANCE = 1.25  # of the camera from the middle, in diagonals of the box around everything


@dataclass(frozen=True)
class View:
    """position and target [m], and the direction that is up."""

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]


def up_of(resolved: str) -> NDArray[np.float64]:
    """Returns the direction against gravity from Scene.resolved; without gravity +y."""
    try:
        gravity = np.array(json.loads(resolved)["effects"]["gravity"]["g"], float)
        length = float(np.linalg.norm(gravity))
    except (ValueError, TypeError, KeyError):
        length = 0.0
    return -gravity / length if 0 < length < np.inf else np.array([0.0, 1.0, 0.0])


def home(low: NDArray, high: NDArray, up: NDArray) -> View:
    """Returns a view of a box from above and in front, along the shorter of its horizontal sides."""
    vertical = int(np.abs(up).argmax())
    first, second = (k for k in range(3) if k != vertical)
    long, short = (first, second) if high[first] - low[first] >= high[second] - low[second] else (second, first)
    direction = np.zeros(3)
    direction[short], direction[long] = 0.85, 0.45
    direction += 0.35 * up
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
    return View(middle + DISTANCE * size * direction / np.linalg.norm(direction), middle, np.asarray(up, float))
