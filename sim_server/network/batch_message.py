# SPDX-License-Identifier: MIT
"""Several jobs in one message: their matrices one after another in one slot, and rooms for their factors in another."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from protocol.channels import PROTOCOL
from protocol.factor import ROOM_ALIGNMENT
from protocol.messages_pb2 import Header, MatrixBatch
from protocol.method import Method
from protocol.shared_memory.pool import Slot
from sim_server.arrays import Float64
from sim_server.network.factor_decoder import AnnouncedObject
from sim_server.network.leases import InFlightJob
from sim_server.network.native_copies import native_copies
from sim_server.updates.factor_source import Job

MOST_TOGETHER = 64  # jobs of a message: as many as a worker on a GPU factorizes together


class Entry(NamedTuple):
    """A job of a batch. room: bytes for its factor, first: of them in the slot"""

    job: Job
    known: AnnouncedObject
    room: int
    first: int


def entries_of(jobs: Sequence[tuple[Job, AnnouncedObject, int]]) -> list[Entry]:
    """Lays out the rooms of factors of one type. jobs: with what is known of their objects, and for how many values of
    a factor there is to be room."""
    made, first, each = [], 0, np.dtype(jobs[0][0].dtype).itemsize
    for job, known, values in jobs:
        room = -(-values * each // ROOM_ALIGNMENT) * ROOM_ALIGNMENT
        made.append(Entry(job, known, room, first))
        first += room
    return made


def batch_message(
    entries: Sequence[Entry], in_flight: Sequence[InFlightJob], leases: Sequence[float], incarnation: int,
    matrix_slot: Slot, factor_slot: Slot,
) -> MatrixBatch:  # fmt: skip
    """Returns the message of a batch without checksums, which `fill` adds.

    entries, in_flight, leases: of the same jobs; leases: time [s] that the worker has for the answer
    """
    first, method = entries[0].job, entries[0].job.method
    known = [entry.known.known_patterns for entry in entries]
    return MatrixBatch(
        header=Header(protocol=PROTOCOL, incarnation=incarnation, sequence=in_flight[-1].number),
        worker=in_flight[0].worker, factor_dtype=first.dtype, method=method.name,
        drop_tolerance=method.drop_tolerance, fill=method.fill, omega=method.omega,
        matrix_slot=matrix_slot.message(), factor_slot=factor_slot.message(),
        objects=[entry.job.object for entry in entries], epochs=[entry.job.epoch for entry in entries],
        jobs=[job.number for job in in_flight], steps=[entry.job.step for entry in entries],
        warps=[entry.job.warp for entry in entries], blocks=[entry.known.blocks for entry in entries],
        rooms=[entry.room for entry in entries], leases=leases,
        known=map(len, known), known_patterns=chain(*known), topologies=[entry.known.topology for entry in entries],
    )  # fmt: skip


def fill(message: MatrixBatch, matrices: Sequence[Float64], slot: Slot) -> None:
    """Copies the matrices of a batch into their slot, and the checksums of the copies into its message. From any
    thread."""
    ends = np.cumsum([matrix.size for matrix in matrices])
    parts = np.split(slot.array(np.float64, int(ends[-1])), ends[:-1])
    message.checksums.extend(native_copies().copy([np.ascontiguousarray(each) for each in matrices], parts))


def group(job: Job) -> tuple[str, Method]:
    """What the jobs of a batch have in common."""
    return job.dtype, job.method
