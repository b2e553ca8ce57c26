# SPDX-License-Identifier: MIT
"""Which of two devices reads what: a plan whose first thread blocks are on one device and whose others on another.

Each device has its own copies of the vectors. What the other one does not read is not written there.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.inverse.partition import COLUMNS, NODE, ROWS
from sim_server.backends.gpu.inverse.plan import FORM, GATHER, READ, Plan

HELPER = Declarations("backends/gpu/helper.cuh")
NEAR_READS: int = HELPER.constant("NEAR_READS")
FAR_READS: int = HELPER.constant("FAR_READS")
FORMED_FAR: int = HELPER.constant("FORMED_FAR")
RESIDUAL_FAR: int = HELPER.constant("RESIDUAL_FAR")
KIND = 3  # bits of a segment's kind

Flags = NDArray[np.bool_]


class Readings(NamedTuple):
    """What the thread blocks of one device read, by packed position, (size,).

    formed: of these it forms the entries, of residual and contributions
    read: entries that were formed by others
    solved: entries of the solution
    residual: entries of the residual, also for z . r
    """

    formed: Flags
    read: Flags
    solved: Flags
    residual: Flags


def readings(plan: Plan, first: int, device: int) -> Readings:
    """Returns what a device reads. device: 0 has the thread blocks before `first`, 1 the others."""
    blocks = np.arange(plan.phases * plan.blocks) % plan.blocks
    mine = (blocks >= first) == device
    segments = plan.segments[np.repeat(mine, np.diff(plan.segment_start))].astype(np.int64)
    kind = segments[:, 0] & KIND
    formed, read = (_covered(segments[kind == k], plan.size) for k in (FORM, READ))
    solved = np.zeros(plan.size + COLUMNS, bool)
    solved[plan.boundary[_covered(segments[kind == GATHER], len(plan.boundary))]] = True
    backward = np.arange(len(mine)) // plan.blocks >= plan.groups - 1
    out = plan.tiles[np.repeat(mine & backward, np.diff(plan.tile_start)), 3]
    residual = formed.copy()
    residual[(out[:, None] + np.arange(ROWS)).ravel()] = True
    return Readings(formed, read, solved[: plan.size], residual)


def _covered(segments: NDArray[np.int64], size: int) -> Flags:
    """Returns which positions are in segments [from, from + count), whole numbers of COLUMNS."""
    change = np.zeros(size // COLUMNS + 1, np.int64)
    np.add.at(change, segments[:, 1] // COLUMNS, 1)
    np.add.at(change, (segments[:, 1] + segments[:, 2]) // COLUMNS, -1)
    return np.repeat(np.cumsum(change)[:-1] > 0, COLUMNS)


class FarFlags:
    """Flags in the lists of a device (device_plan.py): what it writes into the memory of the other, too."""

    def __init__(self, plan: Plan, first: int, device: int):
        self._plan = plan
        self._own, self._other = (readings(plan, first, each) for each in (device, 1 - device))

    def contributions(self) -> NDArray[np.int32]:
        """Returns NEAR_READS, FAR_READS or both for each contribution, (slots,) as in Plan.slots."""
        position = np.repeat(np.arange(self._plan.size), np.diff(self._plan.slot_start))
        near, far = (each.formed[position] for each in (self._own, self._other))
        return (NEAR_READS * near + FAR_READS * far).astype(np.int32)

    def segments(self, segments: NDArray[np.int32]) -> NDArray[np.int32]:
        """Returns FORMED_FAR for each of the segments, (k, 4) of WarpSegment, whose entries the other reads."""
        whole: Flags = np.logical_or.reduce(self._other.read.reshape(-1, COLUMNS), axis=1)
        forms: Flags = segments[:, 0] == FORM
        return np.where(forms & whole[np.where(forms, segments[:, 1], 0) // COLUMNS], FORMED_FAR, 0).astype(np.int32)

    def tiles(self, tiles: NDArray[np.int32], phase: NDArray[np.int64]) -> NDArray[np.int32]:
        """Returns 1 for each of the tiles, (k, 8), with results that the other reads. phase: of each tile"""
        whole: Flags = np.logical_or.reduce(self._other.solved.reshape(-1, ROWS), axis=1)
        solves: Flags = phase >= self._plan.groups - 1
        out = np.where(solves, tiles[:, 3], 0) // ROWS
        found: Flags = solves & (whole[out] | whole[out + (tiles[:, 4] > ROWS)])
        return found.astype(np.int32)

    def places(self) -> NDArray[np.int32]:
        """Returns RESIDUAL_FAR for each node whose residual the other reads, (nodes,)."""
        place = self._plan.place[:, None] + np.arange(NODE)
        return np.where(self._other.residual[place].any(axis=1), RESIDUAL_FAR, 0).astype(np.int32)
