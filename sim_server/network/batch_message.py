# SPDX-License-Identifier: MIT
"""Several jobs in one message: their matrices one after another in one slot, and rooms for their factors in another."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from protocol.channels import PROTOCOL
from protocol.factor import ROOM_ALIGNMENT
from protocol.messages_pb2 import Header, MatrixBatch
from protocol.method import COMPLETE, Method
from protocol.shared_memory.pool import Slot
from sim_server.arrays import Int64
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.jobs_in_flight import JobsInFlight
from sim_server.network.native_copies import native_copies

MOST_TOGETHER = 64  # jobs of a message: as many as a worker on a GPU factorizes together


class BatchLayout(NamedTuple):
    """What is told of the objects of a batch, and where their factors have room, a column each.

    known_patterns: ids of the patterns that they have. rooms, first: bytes, and the first of them in the slot
    """

    blocks: list[int]
    topologies: list[int]
    known_patterns: list[list[int]]
    rooms: Int64
    first: Int64

    @classmethod
    def of(cls, known: Sequence[AnnouncedObject], method: str, dtype: str) -> "BatchLayout":
        """Lays out the rooms of factors by a method, of a type. Those of jobs that must go alone have no bytes."""
        rooms = _rooms([most_values(each, method) for each in known], dtype)
        columns = zip(*((each.blocks, each.topology, each.known_patterns) for each in known), strict=True)
        blocks, topologies, patterns = map(list, columns)
        return cls(blocks, topologies, patterns, rooms, np.cumsum(rooms) - rooms)

    @classmethod
    def of_alike(cls, known: AnnouncedObject, count: int, dtype: str) -> "BatchLayout":
        """Returns that of so many objects of one topology, of whose complete factors the size is known. known: one of
        them. What patterns an object has alone is not told: its worker sends them again."""
        rooms = _rooms([most_values(known, COMPLETE)], dtype)
        blocks, topologies, patterns = [known.blocks] * count, [known.topology] * count, [[*known.complete.patterns]]
        return cls(blocks, topologies, patterns * count, np.repeat(rooms, count), rooms * np.arange(count))

    def part(self, some: slice) -> "BatchLayout":
        """Returns that of a batch of some of the objects."""
        rooms = self.rooms[some]
        columns = self.blocks[some], self.topologies[some], self.known_patterns[some]
        return BatchLayout(*columns, rooms, np.cumsum(rooms) - rooms)

    @property
    def bytes(self) -> int:
        """Of all rooms."""
        return int(self.first[-1] + self.rooms[-1])


def most_values(known: AnnouncedObject, method: str) -> int:
    """Returns for how many values of a factor of an object there is room in a batch; 0 for a job that must go alone, as
    the size of its factor is not known: that of an incomplete one may grow."""
    return 0 if method == "incomplete_cholesky" else known.most_values(method)


def _rooms(values: Sequence[int], dtype: str) -> Int64:
    """Returns the bytes of rooms for so many values of a type."""
    rooms: Int64 = -(-np.array(values, np.int64) * np.dtype(dtype).itemsize // ROOM_ALIGNMENT) * ROOM_ALIGNMENT
    return rooms


def batch_message(
    batch: JobsInFlight, told: BatchLayout, leases: Sequence[float], method: Method, incarnation: int,
    matrix_slot: Slot, factor_slot: Slot,
) -> MatrixBatch:  # fmt: skip
    """Returns the message of a batch without checksums, which `fill` adds. leases: time [s] that the worker has for the
    answer to each"""
    known = told.known_patterns
    return MatrixBatch(
        header=Header(protocol=PROTOCOL, incarnation=incarnation, sequence=batch.numbers[-1]),
        worker=batch.worker, factor_dtype=batch.dtype, method=method.name,
        drop_tolerance=method.drop_tolerance, fill=method.fill, omega=method.omega,
        matrix_slot=matrix_slot.message(), factor_slot=factor_slot.message(),
        objects=batch.objects, epochs=batch.epochs, jobs=batch.numbers, steps=batch.steps, warps=batch.warps,
        blocks=told.blocks, rooms=told.rooms.tolist(), leases=leases,
        known=map(len, known), known_patterns=chain(*known), topologies=told.topologies,
    )  # fmt: skip


def fill(message: MatrixBatch, matrices: Int64, slot: Slot) -> None:
    """Copies the matrices of a batch into their slot, and the checksums of the copies into its message. matrices:
    their addresses. From any thread."""
    size = 72 * np.array(message.blocks, np.int64)
    message.checksums.extend(native_copies().gather(matrices, size, slot.array(np.uint8, slot.capacity)))
