# SPDX-License-Identifier: MIT
"""A job as it travels: the message and the values, in a slot or as bytes."""

from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from protocol.channels import PROTOCOL
from protocol.check import checksum
from protocol.messages_pb2 import Header, Matrix
from protocol.method import Method
from protocol.slots import Slot
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.leases import InFlightJob


def matrix_message(
    flight: InFlightJob, known: AnnouncedObject, incarnation: int, lease: float, method: Method
) -> Matrix:
    """The message beside the values; checksum and matrix slot are filled in by load."""
    message = Matrix(
        header=Header(
            protocol=PROTOCOL,
            incarnation=incarnation,
            object=flight.object,
            epoch=flight.epoch,
            sequence=flight.number,
        ),
        step=flight.step,
        warp=flight.warp,
        blocks=known.blocks,
        factor_dtype=flight.dtype,
        method=method.name,
        drop_tolerance=method.drop_tolerance,
        fill=method.fill,
        omega=method.omega,
        known_patterns=list(known.patterns),
        lease=lease,
        worker=flight.worker,
    )
    if flight.factor_slot is not None:
        message.factor_slot.CopyFrom(flight.factor_slot.message())
    return message


def load(message: Matrix, values: NDArray[np.float64], slot: Slot | None) -> Any:
    """The payload: values (blocks, 3, 3) or positions (nodes, 3), copied into the slot or, without one, into bytes."""
    if values.ndim == 2:
        message.nodes = len(values)
    if slot is None:
        data = values.tobytes()
        message.checksum = checksum(data)
        return zenoh.ZBytes(data)
    copy = slot.array(np.float64, values.size)
    np.copyto(copy.reshape(values.shape), values)
    message.checksum = checksum(copy)
    message.matrix_slot.CopyFrom(slot.message())
    return slot.payload
