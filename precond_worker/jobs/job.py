# SPDX-License-Identifier: MIT
"""A job: a matrix or positions that were received, and checked before use."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import prod
from typing import Any

import numpy as np
import zenoh

from precond_worker.arrays import Float64
from precond_worker.jobs.batch import Batch, accept_batch
from protocol.channels import CHANNELS, check_name, key, name_in
from protocol.messages_pb2 import Matrix, MatrixBatch
from protocol.method import Method
from protocol.refused import Refused
from protocol.shared_memory.pool import HEADER
from protocol.shared_memory.view import SlotMap
from protocol.validate import array, check_header, check_strings, checksum, parse, take

DTYPES = ("float32", "float64")


@dataclass(eq=False)
class Job:
    """A matrix, or positions, of an object.

    number: of the job, header.sequence of the matrix
    dtype: of the factor
    topology: checksum of that of the object; 0: not told
    known_patterns: ids of those that the server has for its factors
    shared: the values came by reference
    batch, place: it is one of several of a message
    """

    object: str
    epoch: int
    number: int
    blocks: int
    dtype: str
    topology: int
    known_patterns: Sequence[int]
    payload: zenoh.ZBytes
    shared: bool
    method: Method
    alone: Matrix | None = None
    batch: Batch | None = None
    place: int = 0

    @cached_property
    def message(self) -> Matrix:
        """The job as it came alone, or would have, then without slots."""
        if self.alone is not None:
            return self.alone
        assert self.batch is not None
        return self.batch.entry(self.place)

    @property
    def positions(self) -> bool:
        """True if the payload holds positions instead of a matrix."""
        return self.alone is not None and self.alone.nodes > 0

    @property
    def on_device(self) -> bool:
        """True if the matrix lies in device memory of the server."""
        return self.alone is not None and self.alone.HasField("device_matrix")

    @property
    def is_plain(self) -> bool:
        """True if it is a matrix in memory of the host."""
        return self.alone is None or not (self.positions or self.on_device)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the values."""
        return (self.message.nodes, 3) if self.positions else (self.blocks, 3, 3)

    def values(self, slots: SlotMap) -> Float64:
        """Returns blocks (blocks, 3, 3) or positions (nodes, 3), in place if in shared memory; raises Refused."""
        values = self.unchecked(slots)
        told = self.message.checksum if self.batch is None else self.batch.message.checksums[self.place]
        if checksum(values) != told:
            raise Refused("Matrix.checksum does not match the values: lost or overwritten", "checksum")
        return values.reshape(self.shape)

    def unchecked(self, slots: SlotMap) -> Float64:
        """Returns the numbers of `values`, (n,), whatever their checksum is; raises Refused."""
        count = prod(self.shape)
        if self.batch is not None:
            return self.batch.matrix(self.place, slots)
        if self.shared:
            return slots.array(self.message.matrix_slot, np.float64, count)
        return array(self._copied(), np.float64, (count,), "Matrix payload")

    def _copied(self) -> bytes:
        data = take(self.payload, CHANNELS["matrix"].bulk, "Matrix payload")
        if self.message.HasField("matrix_slot"):  # a reader without shared memory gets the whole slot
            return data[HEADER : HEADER + 8 * prod(self.shape)]
        return data


def accept(sample: zenoh.Sample, server: str, worker: str, incarnation: int) -> list[Job]:
    """Checks a sample and returns its jobs; raises Refused."""
    if str(sample.key_expr) == key("matrices", server, worker=worker):
        return _jobs_of(accept_batch(sample, worker, incarnation))
    message = parse(Matrix, sample.attachment, CHANNELS["matrix"].limit)
    header = check_header(message, incarnation=incarnation)
    check_strings(message, 256)
    check_name(header.object, "Matrix.header.object")
    if header.object != name_in("matrix", sample.key_expr, "object") or message.worker != worker:
        raise Refused(f"Matrix is for {message.worker!r}, its key is {sample.key_expr}", "worker")
    in_slot = message.HasField("matrix_slot") and sample.payload.as_shm() is not None
    shared = in_slot or message.HasField("device_matrix")
    told = header.object, header.epoch, header.sequence, message.blocks, message.factor_dtype, message.topology
    return [Job(*told, message.known_patterns, sample.payload, shared, _method(message), message)]


def _jobs_of(batch: Batch) -> list[Job]:
    m, method = batch.message, _method(batch.message)
    known = batch.known_patterns
    columns = zip(
        m.objects, m.epochs, m.jobs, m.blocks, m.topologies or [0] * len(m.jobs), known, range(len(known)), strict=True
    )  # fmt: skip
    dtype, values = m.factor_dtype, (batch.payload, batch.shared, method, None, batch)
    return [
        Job(check_name(name, "Matrix.header.object"), epoch, number, blocks, dtype, topology, patterns, *values, place)
        for name, epoch, number, blocks, topology, patterns, place in columns
    ]


def _method(message: Matrix | MatrixBatch) -> Method:
    """Returns how factors are to be made; raises Refused."""
    if message.factor_dtype not in DTYPES:
        raise Refused(f"Matrix.factor_dtype is {message.factor_dtype!r}; allowed: {', '.join(DTYPES)}", "malformed")
    return _checked_method(message.method, message.drop_tolerance, message.fill, message.omega)


@lru_cache(16)
def _checked_method(*fields: Any) -> Method:
    """Returns one object for all jobs of a method, so that few are compared field by field."""
    return Method(*fields).check()
