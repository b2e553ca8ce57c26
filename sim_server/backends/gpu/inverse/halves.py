# SPDX-License-Identifier: MIT
"""Which of two devices reads what: a plan whose first thread blocks are on one device and whose others on another."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.inverse.partition import COLUMNS
from sim_server.backends.gpu.inverse.plan import FORM, Plan

HELPER = Declarations("backends/gpu/helper.cuh")
NEAR: int = HELPER.constant("NEAR_READS")
FAR: int = HELPER.constant("FAR_READS")
KIND = 3  # bits of a segment's kind


def formed_on(plan: Plan, first: int) -> NDArray[np.bool_]:
    """Returns, for thread blocks before `first` and for the others, which packed positions they form, (2, size)."""
    blocks = np.repeat(np.arange(plan.phases * plan.blocks), np.diff(plan.segment_start)) % plan.blocks
    made = np.zeros((2, plan.size // COLUMNS), bool)
    for device in (0, 1):
        mine = plan.segments[((plan.segments[:, 0] & KIND) == FORM) & ((blocks >= first) == device)].astype(np.int64)
        change = np.zeros(plan.size // COLUMNS + 1, np.int64)
        np.add.at(change, mine[:, 1] // COLUMNS, 1)
        np.add.at(change, (mine[:, 1] + mine[:, 2]) // COLUMNS, -1)
        made[device] = np.cumsum(change)[:-1] > 0
    return np.repeat(made, COLUMNS, axis=1)


def readers(plan: Plan, first: int, device: int) -> NDArray[np.int32]:
    """Returns who reads each contribution, as seen from a device: NEAR, FAR or both, (slots,) as in Plan.slots."""
    formed = formed_on(plan, first)
    position = np.repeat(np.arange(plan.size), np.diff(plan.slot_start))
    here, there = formed[device][position], formed[1 - device][position]
    found: NDArray[Any] = NEAR * here + FAR * there
    return found.astype(np.int32)
