# SPDX-License-Identifier: MIT
"""What a loop reports, as another thread reads it: step records and frames, oldest first."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.cpu.structs import RECORD

Reals = NDArray[np.float64]


class Reports:
    """Base of the engines. loop: a ctypes structure with the fields of structs.Rings.

    records: room for so many, four steps at least. frames: memory (capacity, 2, nodes, 3) for x and v of frames, in the
    type that the device has them in.
    """

    records_dtype = RECORD

    def __init__(self, loop: Any, bodies: int, dt: float, records: int, frames: NDArray[Any]):
        self.loop = loop
        self._records = np.zeros(max(records, 4 * bodies), RECORD)
        self._frames = frames
        self._frame_steps = np.zeros(len(frames), np.int64)
        loop.dt = dt
        loop.records, loop.record_capacity = self._records.ctypes.data, len(self._records)
        loop.frames, loop.frame_steps = self._frames.ctypes.data, self._frame_steps.ctypes.data
        loop.frame_capacity = len(frames)
        self._reactions = np.zeros((len(self._records), 0, 6))

    @property
    def step(self) -> int:
        """Steps completed."""
        return int(self.loop.step)

    def report_reactions(self, count: int) -> None:
        """Has records come with the force and torque on each obstacle, and then each holder; count: of all."""
        self._reactions = np.zeros((len(self._records), count, 6))
        self.loop.reactions, self.loop.reaction_count = self._reactions.ctypes.data, count

    def records(self) -> NDArray[Any]:
        """New records since the last call, oldest first, (k,) of RECORD."""
        return self.records_and_reactions()[0]

    def records_and_reactions(self) -> tuple[NDArray[Any], Reals]:
        """New records since the last call, and what each body exerted on each obstacle (with contact) and then each
        holder, (k, count, 6): force [N], then torque about its position at the end of the step [N m]."""
        head, tail, size = int(self.loop.record_head), int(self.loop.record_tail), len(self._records)
        slots = np.arange(tail, head) % size
        out = self._records[slots], self._reactions[slots]
        self.loop.record_tail = head
        return out

    def frames(self) -> list[tuple[int, Reals, Reals]]:
        """New frames since the last call: (step, x (n, 3), v (n, 3)), copied."""
        head, tail = int(self.loop.frame_head), int(self.loop.frame_tail)
        out = []
        for k in range(tail, head):
            slot = k % len(self._frame_steps)
            x, v = (part.astype(np.float64) for part in self._frames[slot])  # copies
            out.append((int(self._frame_steps[slot]), x, v))
            self.loop.frame_tail = k + 1
        return out
