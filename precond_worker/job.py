# SPDX-License-Identifier: MIT
"""A matrix that arrived, checked before anything is computed from it."""

from dataclasses import dataclass
from math import prod

import numpy as np
import zenoh
from numpy.typing import NDArray

from protocol.channels import CHANNELS, name_in
from protocol.check import array, check_header, check_strings, checksum, parse, take
from protocol.messages_pb2 import Matrix
from protocol.method import Method
from protocol.refused import Refused
from protocol.slotmap import SlotMap
from protocol.slots import HEADER

DTYPES = ("float32", "float64")


@dataclass(frozen=True)
class Job:
    """message: what the server asked for; shared: the values came by reference."""

    message: Matrix
    payload: zenoh.ZBytes
    shared: bool
    method: Method

    @property
    def object(self) -> str:
        """Name of the object."""
        return self.message.header.object

    @property
    def positions(self) -> bool:
        """The payload holds positions instead of a matrix."""
        return self.message.nodes > 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the values."""
        return (self.message.nodes, 3) if self.positions else (self.message.blocks, 3, 3)

    def values(self, slots: SlotMap) -> NDArray[np.float64]:
        """(blocks, 3, 3) or positions (nodes, 3), in place where they are in shared memory; raises Refused."""
        count = prod(self.shape)
        if self.shared:
            values = slots.array(self.message.matrix_slot, np.float64, count)
        else:
            values = array(self._copied(), np.float64, (count,), "Matrix payload")
        if checksum(values) != self.message.checksum:
            raise Refused("Matrix.checksum does not match the values: lost or overwritten", "checksum")
        return values.reshape(self.shape)

    def _copied(self) -> bytes:
        data = take(self.payload, CHANNELS["matrix"].bulk, "Matrix payload")
        if self.message.HasField("matrix_slot"):  # the whole slot, as one without shared memory gets it
            return data[HEADER : HEADER + 8 * prod(self.shape)]
        return data


def accept(sample: zenoh.Sample, worker: str, incarnation: int) -> Job:
    """The job in a sample; raises Refused."""
    message = parse(Matrix, sample.attachment, CHANNELS["matrix"].limit)
    header = check_header(message, incarnation=incarnation)
    check_strings(message, 256)
    if header.object != name_in("matrix", sample.key_expr, "object") or message.worker != worker:
        raise Refused(f"Matrix is for {message.worker!r}, its key is {sample.key_expr}", "worker")
    if message.factor_dtype not in DTYPES:
        raise Refused(f"Matrix.factor_dtype is {message.factor_dtype!r}; allowed: {', '.join(DTYPES)}", "malformed")
    method = Method(message.method, message.drop_tolerance, message.fill, message.omega).check()
    shared = message.HasField("matrix_slot") and sample.payload.as_shm() is not None
    return Job(message, sample.payload, shared, method)
