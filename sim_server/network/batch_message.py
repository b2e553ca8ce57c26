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
from sim_server.arrays import Float64, Int64
from sim_server.network.factor_decoder import AnnouncedObject, CompleteFactors
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
        """Lays out the rooms of factors by a method, of a type."""
        values, room = np.array(most_values(known, method), np.int64), np.dtype(dtype).itemsize
        rooms = -(-values * room // ROOM_ALIGNMENT) * ROOM_ALIGNMENT
        blocks, topologies = [each.blocks for each in known], [each.topology for each in known]
        return cls(blocks, topologies, _known_patterns(known), rooms, np.cumsum(rooms) - rooms)

    @property
    def bytes(self) -> int:
        """Of all rooms."""
        return int(self.first[-1] + self.rooms[-1])


def most_values(known: Sequence[AnnouncedObject], method: str) -> list[int]:
    """Returns for how many values of a factor of each object there is room in a batch; 0 for a job that must go alone,
    as the size of its factor is not known: that of an incomplete one may grow."""
    if method == "incomplete_cholesky":
        return [0] * len(known)
    if method == COMPLETE and (shared := _shared(known)) is not None and shared.sizes:
        return [max(shared.sizes.values())] * len(known)
    return [each.most_values(method) for each in known]


def _known_patterns(known: Sequence[AnnouncedObject]) -> list[list[int]]:
    shared = _shared(known)
    if shared is None or any(each.patterns and not each.patterns.keys() <= shared.patterns.keys() for each in known):
        return [each.known_patterns for each in known]
    return [list(shared.patterns)] * len(known)


def _shared(known: Sequence[AnnouncedObject]) -> CompleteFactors | None:
    """What objects of one topology share; None: they are of several."""
    first = known[0].complete
    return first if all(each.complete is first for each in known) else None


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


def fill(message: MatrixBatch, matrices: Sequence[Float64], slot: Slot) -> None:
    """Copies the matrices of a batch into their slot, and the checksums of the copies into its message. From any
    thread."""
    message.checksums.extend(native_copies().gather(matrices, slot.array(np.uint8, slot.capacity)))
