# SPDX-License-Identifier: MIT
"""The colour map viridis, whose lightness grows evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Viridis (S. van der Walt, N. Smith, CC0) at 21 even places; linear in between, within 4/255 of the full table.
_ANCHORS = np.array(
    [
        (68, 1, 84), (72, 20, 102), (72, 37, 117), (70, 52, 128), (65, 68, 135), (59, 82, 139), (52, 95, 141),
        (47, 108, 142), (42, 120, 142), (37, 132, 142), (33, 144, 140), (30, 156, 137), (34, 168, 132), (47, 180, 124),
        (67, 191, 113), (93, 201, 99), (122, 209, 81), (154, 217, 61), (188, 223, 39), (221, 227, 24), (253, 231, 37),
    ]
)  # fmt: skip


def colors(values: NDArray, top: float) -> NDArray[np.uint8]:
    """Maps values (n,) between 0 and `top` to RGBA (n, 4); outside they saturate, NaN is grey."""
    place = np.clip(np.nan_to_num(values) / top if top > 0 else np.zeros(len(values)), 0, 1) * (len(_ANCHORS) - 1)
    rgba = np.full((len(values), 4), 255, np.uint8)
    for channel in range(3):
        rgba[:, channel] = np.rint(np.interp(place, np.arange(len(_ANCHORS)), _ANCHORS[:, channel]))
    rgba[np.isnan(values)] = (128, 128, 128, 255)
    return rgba
