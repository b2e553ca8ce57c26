# SPDX-License-Identifier: MIT
"""What a loop reports, as another thread reads it: step records and frames, oldest first."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.backends.cpu.structs import REACTION, RECORD
from sim_server.backends.measured import Measured, first_of_bodies
from sim_server.backends.reused_memory import ReusedMemory

Reals = NDArray[np.float64]
OTHERS = 1 << 15  # reactions on grabs and other bodies that may wait to be read
RECORDS, STEPS = 8192, 32  # room for so many records, and for those of so many steps where bodies are many


class Reports:
    """Base of the engines. loop: a ctypes structure with the fields of structs.Rings.

    records: room for so many, four steps at least; None: RECORDS, those of STEPS at least. frames: memory (capacity, 2,
    nodes, 3) for x and v of frames, in the type that the device has them in. memory: makes so many bytes for records;
    None: ordinary ones.

    frame_poses: of the frames returned last, by step: position [m] and quaternion of each obstacle (obstacles, 7)
    readings: of the records returned last, the numbers that effects leave of the body of each (measured.py), (k, most)
    """

    records_dtype = RECORD

    def __init__(
        self, loop: Any, bodies: int, dt: float, records: int | None, frames: NDArray[Any],
        memory: Callable[[int], NDArray[np.uint8]] | None = None,
    ):  # fmt: skip
        self.loop = loop
        room = max(RECORDS, STEPS * bodies) if records is None else max(records, 4 * bodies)
        self._records = memory(room * RECORD.itemsize).view(RECORD) if memory else np.zeros(room, RECORD)
        self._frames = frames
        self._frame_steps = np.zeros(len(frames), np.int64)
        loop.dt = dt
        loop.records, loop.record_capacity = self._records.ctypes.data, len(self._records)
        loop.frames, loop.frame_steps = self._frames.ctypes.data, self._frame_steps.ctypes.data
        loop.frame_capacity = len(frames)
        self._reactions = np.zeros((len(self._records), 0, 6))
        self._readings, self.readings = np.zeros((len(self._records), 0)), np.zeros((0, 0))
        self._others = np.zeros(OTHERS, REACTION)
        loop.others, loop.other_capacity = self._others.ctypes.data, OTHERS
        self._frame_poses = np.zeros((len(frames), 0, 7))
        self.frame_poses: dict[int, Reals] = {}
        self._memory = ReusedMemory()  # of records that were read
        self._reported = 0  # step of the newest record that was read

    @property
    def step(self) -> int:
        """Steps completed."""
        return int(self.loop.step)

    def report_reactions(self, count: int, obstacles: int, poses: Reals | None = None) -> None:
        """Has records come with the force and torque on each obstacle, and then each holder; count: of all.

        Frames come with where obstacles are. poses: memory (frames, obstacles, 7) for that; None: ordinary one
        """
        self._reactions = np.zeros((len(self._records), count, 6))
        self.loop.reactions, self.loop.reaction_count = self._reactions.ctypes.data, count
        self._frame_poses = np.zeros((len(self._frames), obstacles, 7)) if poses is None else poses
        self.loop.frame_poses = self._frame_poses.ctypes.data

    def report_readings(self, measured: Sequence[Measured], bodies: int) -> Int32:
        """Has records come with the numbers of their bodies. Returns the place of the first one of each body."""
        first = first_of_bodies(measured, bodies)
        most = int(np.diff(first).max())
        self._readings = np.zeros((len(self._records), most))
        self.loop.readings, self.loop.most_readings = self._readings.ctypes.data, most
        return first

    def records(self) -> NDArray[Any]:
        """New records since the last call, oldest first, (k,) of RECORD."""
        return self.records_and_reactions()[0]

    def records_and_reactions(self) -> tuple[NDArray[Any], Reals]:
        """New records since the last call, and what each body exerted on each obstacle (with contact) and then each
        holder, (k, count, 6): force [N], then torque about its position at the end of the step [N m]."""
        head, tail = int(self.loop.record_head), int(self.loop.record_tail)
        rings = self._records, self._reactions, self._readings
        *out, self.readings = (part_of_ring(ring, tail, head, self._memory) for ring in rings)
        self.loop.record_tail = head
        if head > tail:
            self._reported = int(out[0]["step"][-1])
        records, reactions = out
        return records, reactions

    def other_reactions(self) -> NDArray[Any]:
        """What bodies exerted on grabs and on each other, (k,) of REACTION, up to the newest record that was read."""
        head, tail = int(self.loop.other_head), int(self.loop.other_tail)
        if head == tail:
            return np.zeros(0, REACTION)
        out = part_of_ring(self._others, tail, head, self._memory)
        out = out[: np.searchsorted(out["step"], self._reported, "right")]
        self.loop.other_tail = tail + len(out)
        return out

    def frames(self) -> list[tuple[int, Reals, Reals]]:
        """New frames since the last call: (step, x (n, 3), v (n, 3)), copied."""
        head, tail = int(self.loop.frame_head), int(self.loop.frame_tail)
        out = []
        self.frame_poses = {}
        for k in range(tail, head):
            slot = k % len(self._frame_steps)
            x, v = (part.astype(np.float64) for part in self._frames[slot])  # copies
            out.append((int(self._frame_steps[slot]), x, v))
            self.frame_poses[out[-1][0]] = self._frame_poses[slot].copy()
            self.loop.frame_tail = k + 1
        return out


def part_of_ring(ring: NDArray[Any], tail: int, head: int, memory: ReusedMemory) -> NDArray[Any]:
    """Copies the entries from number `tail` up to `head`, not included, of a ring. memory: for the copy"""
    first, count = tail % len(ring), head - tail
    out = memory.empty((count, *ring.shape[1:]), ring.dtype)
    if not out.size:
        return out
    source, target, size = _bytes_of(ring), _bytes_of(out), out.nbytes // count
    straight = size * min(count, len(ring) - first)
    target[:straight] = source[size * first : size * first + straight]
    target[straight:] = source[: size * count - straight]
    return out


def _bytes_of(array: NDArray[Any]) -> memoryview:
    """Views a contiguous array as bytes. NumPy would copy these without Python's lock, which takes longer to get back,
    where other threads are at work, than to copy the records of a batch."""
    return array.reshape(-1).view(np.uint8).data


def as_bytes(structs: NDArray[Any]) -> NDArray[Any]:
    """Views structs as bytes, which NumPy copies twenty times as fast: structs it copies member by member."""
    return structs.view(np.dtype((np.void, structs.dtype.itemsize))) if structs.size else structs
