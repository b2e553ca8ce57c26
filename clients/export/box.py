# SPDX-License-Identifier: MIT
"""The box around the bodies of a log, by which planes are drawn in a size that shows."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clients.log.reader import Log


def box_of(log: Log, names: Iterable[str]) -> tuple[NDArray, NDArray]:
    """Returns the corners (3,), (3,) [m] of a box around the first and last frame of each object that are finite."""
    found = [log.frame(name, index).x for name in names if log.object_log(name).frames for index in (0, -1)]
    finite = [x for x in found if len(x) and np.isfinite(x).all()]
    if not finite:
        return np.zeros(3), np.ones(3)
    return np.min([x.min(axis=0) for x in finite], axis=0), np.max([x.max(axis=0) for x in finite], axis=0)
