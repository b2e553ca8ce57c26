# SPDX-License-Identifier: MIT
"""Jobs that were sent to a worker in one message, by columns; a job alone is the only one of its message."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import repeat

import numpy as np

from protocol.shared_memory.pool import Slot
from sim_server.arrays import Float64, Int64
from sim_server.network.device_slots import DeviceSlot


@dataclass(eq=False, slots=True)
class JobsInFlight:
    """Jobs sent to one worker in one message, with a column of an entry for each, and what they have in common. Times
    are monotonic [s].

    numbers: of the jobs, unique in the life of the server
    objects, epochs, steps, warps: of their matrices
    first, rooms: first byte and bytes of the slot of the factors that are for each, int64
    sent_at, deadlines: begin and ends of their leases
    exclusive_until: from then on another worker may be asked for an object
    put_at: when the network took them; inf: it has not yet
    matrices: what was sent of each, which is read until its job is over, and `matrices_at` their addresses; none: of a
        job alone
    bodies: numbers by which the sender of jobs knows their objects, likewise; None: it has told none
    factor_slot, factor_generation: shared memory that was lent for the factors; None: they travel as bytes
    slots: all that was lent for matrices and factors, of the host or of a device
    payload_bytes: size of the values if they are in no slot
    positions: the values are positions, from which the worker assembles the matrix
    part_bytes: of each part of a factor that travels in parts
    device_slot, device_generation: in place of factor_slot, of a device
    jobs: a row for each, until they are started: rows hold their batch, and what it holds is to be free as soon as the
        last of them is over
    """

    worker: str
    dtype: str
    method: str
    numbers: Sequence[int]
    objects: list[str]
    epochs: list[int]
    steps: list[int]
    warps: list[bool]
    deadlines: Float64
    exclusive_until: Float64
    sent_at: float = 0.0
    first: Int64 = field(default_factory=lambda: np.zeros(1, np.int64))
    rooms: Int64 = field(default_factory=lambda: np.zeros(1, np.int64))
    matrices: Sequence[Float64] = ()
    matrices_at: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    bodies: Int64 | None = None
    factor_slot: Slot | None = None
    factor_generation: int = 0
    slots: tuple[Slot | DeviceSlot, ...] = ()
    payload_bytes: int = 0
    positions: bool = False
    part_bytes: int = 0
    device_slot: DeviceSlot | None = None
    device_generation: int = 0
    put_at: float = float("inf")
    jobs: "list[InFlightJob]" = field(init=False)

    def __post_init__(self) -> None:
        self.jobs = list(map(InFlightJob, self.numbers, self.objects, repeat(self), range(len(self.objects))))

    def __len__(self) -> int:
        return len(self.objects)


class InFlightJob:
    """One of the jobs of a message: a row of its batch, whose attributes it has."""

    __slots__ = ("batch", "number", "object", "place")

    def __init__(self, number: int, object: str, batch: JobsInFlight, place: int):
        self.number, self.object, self.batch, self.place = number, object, batch, place

    def __repr__(self) -> str:
        return f"job {self.number} of {self.object} at {self.worker}"

    @property
    def epoch(self) -> int:
        """Epoch of the object in its matrix."""
        return self.batch.epochs[self.place]

    @property
    def step(self) -> int:
        """Step of its matrix."""
        return self.batch.steps[self.place]

    @property
    def warp(self) -> bool:
        """True if its matrix is in the material frame."""
        return self.batch.warps[self.place]

    @property
    def first(self) -> int:
        """First byte of the slot of the factors that is for this one."""
        return int(self.batch.first[self.place])

    @property
    def room(self) -> int:
        """Bytes from there; 0: all."""
        return int(self.batch.rooms[self.place])

    @property
    def deadline(self) -> float:
        """End of its lease [s, monotonic]."""
        return float(self.batch.deadlines[self.place])

    @property
    def exclusive_until(self) -> float:
        """From when on another worker may be asked for the object [s, monotonic]."""
        return float(self.batch.exclusive_until[self.place])

    @property
    def sent_at(self) -> float:
        """Begin of its lease [s, monotonic]."""
        return self.batch.sent_at

    @property
    def put_at(self) -> float:
        """When the network took it [s, monotonic]; inf: it has not yet."""
        return self.batch.put_at

    @property
    def worker(self) -> str:
        """Worker that it was sent to."""
        return self.batch.worker

    @property
    def dtype(self) -> str:
        """Type of the factor to be made."""
        return self.batch.dtype

    @property
    def method(self) -> str:
        """Name of the method by which it is to be made."""
        return self.batch.method

    @property
    def factor_slot(self) -> Slot | None:
        """As of JobsInFlight, like all below."""
        return self.batch.factor_slot

    @property
    def factor_generation(self) -> int:
        """Of the slot when it was lent."""
        return self.batch.factor_generation

    @property
    def slots(self) -> tuple[Slot | DeviceSlot, ...]:
        """All that was lent for it and those with it."""
        return self.batch.slots

    @property
    def payload_bytes(self) -> int:
        """Size of its values if they are in no slot."""
        return self.batch.payload_bytes

    @property
    def positions(self) -> bool:
        """True if its values are positions."""
        return self.batch.positions

    @property
    def part_bytes(self) -> int:
        """Of each part of a factor that travels in parts."""
        return self.batch.part_bytes

    @property
    def device_slot(self) -> DeviceSlot | None:
        """Slot of a device in place of factor_slot."""
        return self.batch.device_slot

    @property
    def device_generation(self) -> int:
        """Of that slot when it was lent."""
        return self.batch.device_generation
