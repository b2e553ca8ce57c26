# SPDX-License-Identifier: MIT
"""A job: a matrix or positions that were received, and checked before use."""

from dataclasses import dataclass
from math import prod

import numpy as np
import zenoh

from precond_worker.arrays import Float64
from precond_worker.batch import Batch, accept_batch
from protocol.channels import CHANNELS, check_name, key, name_in
from protocol.messages_pb2 import Matrix
from protocol.method import Method
from protocol.refused import Refused
from protocol.shared_memory.pool import HEADER
from protocol.shared_memory.view import SlotMap
from protocol.validate import array, check_header, check_strings, checksum, parse, take

DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Job:
    """message: of the server; shared: the values came by reference; batch, place: it is one of several of a message."""

    message: Matrix
    payload: zenoh.ZBytes
    shared: bool
    method: Method
    batch: Batch | None = None
    place: int = 0

    @property
    def object(self) -> str:
        """Name of the object."""
        return self.message.header.object

    @property
    def positions(self) -> bool:
        """True if the payload holds positions instead of a matrix."""
        return self.message.nodes > 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the values."""
        return (self.message.nodes, 3) if self.positions else (self.message.blocks, 3, 3)

    def values(self, slots: SlotMap) -> Float64:
        """Returns blocks (blocks, 3, 3) or positions (nodes, 3), in place if in shared memory; raises Refused."""
        count = prod(self.shape)
        if self.batch is not None:
            values = self.batch.matrix(self.place, slots)
        elif self.shared:
            values = slots.array(self.message.matrix_slot, np.float64, count)
        else:
            values = array(self._copied(), np.float64, (count,), "Matrix payload")
        if checksum(values) != self.message.checksum:
            raise Refused("Matrix.checksum does not match the values: lost or overwritten", "checksum")
        return values.reshape(self.shape)

    def _copied(self) -> bytes:
        data = take(self.payload, CHANNELS["matrix"].bulk, "Matrix payload")
        if self.message.HasField("matrix_slot"):  # a reader without shared memory gets the whole slot
            return data[HEADER : HEADER + 8 * prod(self.shape)]
        return data


def accept(sample: zenoh.Sample, server: str, worker: str, incarnation: int) -> list[Job]:
    """Checks a sample and returns its jobs; raises Refused."""
    if str(sample.key_expr) == key("matrices", server, worker=worker):
        batch = accept_batch(sample, worker, incarnation)
        entries = [batch.entry(place) for place in range(len(batch.message.jobs))]
        return [
            Job(entry, batch.payload, batch.shared, _method(entry), batch, place) for place, entry in enumerate(entries)
        ]
    message = parse(Matrix, sample.attachment, CHANNELS["matrix"].limit)
    header = check_header(message, incarnation=incarnation)
    check_strings(message, 256)
    if header.object != name_in("matrix", sample.key_expr, "object") or message.worker != worker:
        raise Refused(f"Matrix is for {message.worker!r}, its key is {sample.key_expr}", "worker")
    shared = message.HasField("matrix_slot") and sample.payload.as_shm() is not None
    return [Job(message, sample.payload, shared, _method(message))]


def _method(message: Matrix) -> Method:
    """Returns how the factor is to be made; raises Refused."""
    check_name(message.header.object, "Matrix.header.object")
    if message.factor_dtype not in DTYPES:
        raise Refused(f"Matrix.factor_dtype is {message.factor_dtype!r}; allowed: {', '.join(DTYPES)}", "malformed")
    return Method(message.method, message.drop_tolerance, message.fill, message.omega).check()
