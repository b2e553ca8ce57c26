# SPDX-License-Identifier: MIT
"""Jobs that came in one message, and their answers, which leave in one message."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int64
from precond_worker.network.native_copies import native_copies
from protocol.channels import CHANNELS, MOST_JOBS
from protocol.factor import ROOM_ALIGNMENT, FactorPattern
from protocol.messages_pb2 import FactorBatch, Header, Matrix, MatrixBatch
from protocol.refused import Refused
from protocol.shared_memory.copies import Parts
from protocol.shared_memory.pool import HEADER
from protocol.shared_memory.view import SlotMap
from protocol.validate import array, check_header, check_strings, parse, take

ENTRY = 9  # values of a block
LARGEST = 1 << 62  # bytes; no slot has as many


@dataclass(eq=False)
class Batch:
    """A message with several jobs; shared: its values came by reference."""

    message: MatrixBatch
    payload: zenoh.ZBytes
    shared: bool

    @cached_property
    def starts(self) -> Int64:
        """Index of the first value of each matrix, and the number of all, (jobs + 1,)."""
        return np.concatenate([[0], np.cumsum(ENTRY * np.array(self.message.blocks, np.int64))])

    @cached_property
    def rooms(self) -> Int64:
        """First byte of the room of each factor, and the bytes of all, (jobs + 1,)."""
        return np.concatenate([[0], np.cumsum(np.array(self.message.rooms, np.int64))])

    @cached_property
    def known_patterns(self) -> list[list[int]]:
        """Ids of the patterns that the server has for each job."""
        ends, every = np.cumsum(self.message.known).tolist(), list(self.message.known_patterns)
        return [every[end - count : end] for end, count in zip(ends, self.message.known, strict=True)]

    def values(self, slots: SlotMap) -> Float64:
        """Returns the values of all matrices one after another, in place if in shared memory; raises Refused."""
        if self.shared:
            return slots.array(self.message.matrix_slot, np.float64, int(self.starts[-1]))
        return self._copied

    @cached_property
    def _copied(self) -> Float64:
        data = take(self.payload, CHANNELS["matrices"].bulk, "MatrixBatch payload")
        size = 8 * int(self.starts[-1])
        copied = data[HEADER : HEADER + size]  # a reader without shared memory gets the whole slot
        return array(copied, np.float64, (size // 8,), "MatrixBatch payload")

    def matrix(self, place: int, slots: SlotMap) -> Float64:
        """Returns the values of one of the matrices, in place if in shared memory; raises Refused."""
        begin, end = self.starts[[place, place + 1]].tolist()
        return self.values(slots)[begin:end]

    def entry(self, place: int) -> Matrix:
        """Returns one of the jobs as it would come alone, without slots."""
        m = self.message
        header = Header(
            protocol=m.header.protocol, incarnation=m.header.incarnation, object=m.objects[place],
            epoch=m.epochs[place], sequence=m.jobs[place],
        )  # fmt: skip
        return Matrix(
            header=header, step=m.steps[place], warp=m.warps[place], blocks=m.blocks[place],
            checksum=m.checksums[place], factor_dtype=m.factor_dtype, method=m.method,
            known_patterns=self.known_patterns[place], lease=m.leases[place], worker=m.worker,
            drop_tolerance=m.drop_tolerance, fill=m.fill, omega=m.omega,
            topology=m.topologies[place] if m.topologies else 0,
        )  # fmt: skip


def accept_batch(sample: zenoh.Sample, worker: str, incarnation: int) -> Batch:
    """Checks a sample with several jobs but for the values; raises Refused."""
    message = parse(MatrixBatch, sample.attachment, CHANNELS["matrices"].limit)
    check_header(message, incarnation=incarnation)
    check_strings(message, 256)
    if message.worker != worker:
        raise Refused(f"MatrixBatch is for {message.worker!r}, its key is {sample.key_expr}", "worker")
    count = len(message.jobs)
    columns = ("objects", "epochs", "steps", "warps", "blocks", "checksums", "rooms", "leases", "known")
    lengths = {name: len(getattr(message, name)) for name in columns}
    if not 0 < count <= MOST_JOBS or any(length != count for length in lengths.values()):
        raise Refused(f"MatrixBatch.jobs has {count} numbers, other fields {lengths}; allowed: as many", "shape")
    if len(message.topologies) not in (0, count):
        raise Refused(f"MatrixBatch.topologies has {len(message.topologies)}; allowed: none or {count}", "shape")
    if sum(message.known) != len(message.known_patterns):
        raise Refused(f"MatrixBatch.known_patterns has {len(message.known_patterns)}, not those of `known`", "shape")
    shared = sample.payload.as_shm() is not None
    batch = Batch(message, sample.payload, shared)
    # Summed up as Python's numbers: those of 64 bits could be exceeded, and every room must lie inside
    needs = 8 * ENTRY * sum(message.blocks), sum(message.rooms)
    for slot, needed in zip((message.matrix_slot, message.factor_slot), needs, strict=True):
        if needed > min(slot.capacity, LARGEST):
            raise Refused(f"MatrixBatch has a slot of {slot.capacity} bytes; needed: {needed}", "slot")
    if any(room % ROOM_ALIGNMENT for room in message.rooms):
        raise Refused(f"MatrixBatch.rooms: not all are multiples of {ROOM_ALIGNMENT}", "slot")
    return batch


class BatchAnswer:
    """Answers to jobs of one batch, until they are sent."""

    def __init__(self, batch: Batch, header: Header, worker: str):
        self._batch = batch
        self.message = FactorBatch(
            header=header, worker=worker, slot=batch.message.factor_slot, matrix_shared=batch.shared
        )
        self._failures: list[str] = []
        self._remedies: list[str] = []

    def add(
        self, places: Sequence[int], slots: SlotMap, pattern: FactorPattern, values: NDArray[Any], rows: Sequence[int],
        seconds: float, remedy: str = "",
    ) -> list[int]:  # fmt: skip
        """Writes factors of one pattern into their rooms; returns the places of those that are too large for theirs.
        Raises Refused if this answer is late.

        places, rows: of the jobs, and of their factors in `values`, (k, nonzeros)
        """
        slot, every = self._batch.message.factor_slot, self._batch.rooms
        size, where, row = values[0].nbytes, np.array(places), np.array(rows)
        fits = every[where + 1] - every[where] >= size
        room = slots.array(slot, np.uint8, int(every[-1]))
        if not slots.is_current(slot):
            raise Refused("the slot for factors was lent to somebody else: this answer is late", "late")
        written = where[fits]
        sources, targets = Parts(values, size * row[fits]), Parts(room, every[written])
        sums = native_copies().copy_parts(sources, targets, np.full(len(written), size), own_sources=True)
        self._add(written.tolist(), pattern.id, pattern.nonzeros, sums, seconds, "", remedy)
        return list(where[~fits].tolist())

    def add_failure(self, place: int, failure: str) -> None:
        """Adds why a job has no factor."""
        self._add([place], 0, 0, [0], 0.0, failure, "")

    def _add(
        self, places: Sequence[int], pattern: int, nonzeros: int, sums: Sequence[int], seconds: float, failure: str,
        remedy: str,
    ) -> None:  # fmt: skip
        m, jobs, count = self.message, self._batch.message.jobs, len(places)
        m.jobs.extend([jobs[place] for place in places])
        m.patterns.extend([pattern] * count)
        m.nonzeros.extend([nonzeros] * count)
        m.checksums.extend(sums)
        m.seconds.extend([seconds] * count)
        self._failures += [failure] * count
        self._remedies += [remedy] * count

    def finished(self) -> FactorBatch:
        """Returns the message."""
        if any(self._failures):
            self.message.failures.extend(self._failures)
        if any(self._remedies):
            self.message.remedies.extend(self._remedies)
        return self.message
