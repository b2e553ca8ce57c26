# SPDX-License-Identifier: MIT
"""Encodes a job for the network: a message, and the values in a slot of shared memory or as bytes."""

import numpy as np
import zenoh

from protocol.channels import PROTOCOL
from protocol.messages_pb2 import Header, Matrix
from protocol.method import Method
from protocol.shared_memory.pool import Slot
from protocol.validate import checksum, copied
from sim_server.arrays import Float64
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.jobs_in_flight import InFlightJob


def matrix_message(job: InFlightJob, known: AnnouncedObject, incarnation: int, lease: float, method: Method) -> Matrix:
    """Returns the message of a job without checksum, matrix slot and nodes, which `add_values` fills in unless the
    matrix is on a device.

    lease: time [s] that the worker has for its answer
    """
    message = Matrix(
        header=Header(
            protocol=PROTOCOL,
            incarnation=incarnation,
            object=job.object,
            epoch=job.epoch,
            sequence=job.number,
        ),
        step=job.step,
        warp=job.warp,
        blocks=known.blocks,
        factor_dtype=job.dtype,
        method=method.name,
        drop_tolerance=method.drop_tolerance,
        fill=method.fill,
        omega=method.omega,
        known_patterns=known.known_patterns,
        topology=known.topology,
        lease=lease,
        worker=job.worker,
        part_bytes=job.part_bytes,
    )
    if job.factor_slot is not None:
        message.factor_slot.CopyFrom(job.factor_slot.message())
    if job.device_slot is not None:
        message.device_factor.CopyFrom(job.device_slot.message())
    return message


def add_values(message: Matrix, values: Float64, slot: Slot | None) -> zenoh.ZBytes:
    """Copies the values into the slot, or into bytes without one, and describes them in the message.

    values: blocks of the matrix (blocks, 3, 3) or positions (nodes, 3) [m]

    Returns the payload to be sent.
    """
    if values.ndim == 2:
        message.nodes = len(values)
    if slot is None:
        data = values.tobytes()
        message.checksum = checksum(data)
        return zenoh.ZBytes(data)
    own = np.ascontiguousarray(values).reshape(-1)
    message.checksum, _ = copied(own, slot.array(np.float64, values.size), own=own)
    message.matrix_slot.CopyFrom(slot.message())
    return slot.payload
