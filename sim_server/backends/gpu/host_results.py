# SPDX-License-Identifier: MIT
"""Page-locked memory of the host that the steps of a GPU write their results to."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import EngineInput
from sim_server.backends.gpu.loop import CAPACITY, LoopDevice
from sim_server.backends.gpu.structs import (
    CONTACT_RESULT,
    NEWTON_RESULT,
    PAIR_SUM,
    STAGE_RESULT,
    STEP_TIMESTAMP,
    SUBSTEP_RESULT,
)

MOST_TOLD = 16  # other bodies whose forces on a body are told, at most
Bytes = NDArray[np.uint8]
PairsTold = tuple[NDArray[Any], NDArray[Any]]
"""What bodies exert on each other: (capacity, bodies, most) of PAIR_SUM; (capacity, bodies) how many each has."""


@dataclass(frozen=True)
class ContactResults:
    """Results of steps with contact.

    solves: (CAPACITY, bodies) of CONTACT_RESULT as bytes
    reactions: (CAPACITY, bodies, obstacles, 6) force [N] and torque [N m] on each obstacle
    broken: (ties,) steps completed when each tie broke
    pairs: of bodies that touch each other; None: they do not
    """

    solves: NDArray[Any]
    reactions: Float64
    broken: Int32
    pairs: PairsTold | None


@dataclass(frozen=True)
class HostResults:
    """Results of the last CAPACITY steps: structs as bytes, (CAPACITY,) or (CAPACITY, bodies) of each.

    timestamps: of STEP_TIMESTAMP. newton: of NEWTON_RESULT. stages: of STAGE_RESULT. substeps: of SUBSTEP_RESULT
    contact: of steps with contact
    held: (CAPACITY, bodies, holders, 6) force [N] and torque [N m] on each holder
    measured: (CAPACITY, numbers) that effects leave

    None: the scene has no such thing.
    """

    timestamps: Bytes
    newton: Bytes | None
    stages: Bytes | None
    substeps: Bytes | None
    contact: ContactResults | None
    held: Float64 | None
    measured: Float64 | None

    @classmethod
    def allocated(cls, device: LoopDevice, given: EngineInput) -> "HostResults":
        """Allocates the memory that steps of a scene need."""

        def structs(dtype: np.dtype[Any], there: object) -> Bytes | None:
            return device.pinned(CAPACITY * dtype.itemsize * len(given.ranges)) if there else None

        def numbers(*shape: int) -> Float64:
            return device.pinned(CAPACITY * 8 * int(np.prod(shape))).view(np.float64).reshape(CAPACITY, *shape)

        return cls(
            timestamps=device.pinned(CAPACITY * STEP_TIMESTAMP.itemsize),
            newton=structs(NEWTON_RESULT, given.newton),
            stages=structs(STAGE_RESULT, given.stages),
            substeps=structs(SUBSTEP_RESULT, given.substeps),
            contact=_contact_results(device, given),
            held=None if given.held is None else numbers(*given.held.shape),
            measured=numbers(len(given.measured)) if given.measured else None,
        )


def _contact_results(device: LoopDevice, given: EngineInput) -> ContactResults | None:
    contact, bodies = given.contact, len(given.ranges)
    if contact is None:
        return None
    obstacles, ties = len(contact.obstacles.kind), len(contact.ties.broken) if contact.ties else 0
    reactions = device.pinned(CAPACITY * bodies * obstacles * 48).view(np.float64)
    pairs = None
    if contact.surfaces:
        most = min(bodies - 1, MOST_TOLD)
        sums = device.pinned(CAPACITY * bodies * most * PAIR_SUM.itemsize).view(PAIR_SUM)
        counts = device.pinned(CAPACITY * bodies * 4).view(np.int32)
        pairs = sums.reshape(CAPACITY, bodies, most), counts.reshape(CAPACITY, bodies)
    return ContactResults(
        solves=device.pinned(CAPACITY * CONTACT_RESULT.itemsize * bodies),
        reactions=reactions.reshape(CAPACITY, bodies, obstacles, 6),
        broken=device.pinned(4 * ties).view(np.int32),
        pairs=pairs,
    )
