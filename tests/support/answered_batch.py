# SPDX-License-Identifier: MIT
"""Answers to the jobs of one message, all of them good."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from precond_worker.factorization.factorize import Analysis
from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import FactorBatch, Header, Topology
from protocol.messages_pb2 import Slot as SlotMessage
from protocol.validate import checksum
from sim_server.network.factor_decoder import FactorDecoder
from tests.support.in_flight import batch_in_flight
from tests.worker.block_matrices import bar_edges, pattern, spd

GRAPHS = [pattern(12, bar_edges(1, 1, 2)), pattern(8, bar_edges(1, 1, 1))]
MADE = [Analysis(*graph) for graph in GRAPHS]
KINDS = {"a": 0, "b": 0, "c": 1, "d": 0, "e": 0}  # of the objects
ROOM = 1 << 14  # bytes


class Memory:
    """A slot of shared memory. bytes: of it"""

    segment, offset = "7.zenoh", 64

    def __init__(self) -> None:
        self.bytes = np.zeros(len(KINDS) * ROOM, np.uint8)
        self.capacity = self.bytes.nbytes

    def part(self, first: int, dtype: Any, count: int) -> np.ndarray:
        return self.bytes[first : first + count * np.dtype(dtype).itemsize].view(dtype)


def answered() -> SimpleNamespace:
    """Returns decoder, slot, message, batch of jobs, and values by object."""
    decoder, slot = FactorDecoder(7), Memory()
    message = FactorBatch(
        header=Header(protocol=PROTOCOL, incarnation=7), worker="w",
        slot=SlotMessage(segment=slot.segment, offset=slot.offset, capacity=slot.capacity, generation=3),
    )  # fmt: skip
    values = {}
    for place, (name, kind) in enumerate(KINDS.items()):
        (row_start, columns), made = GRAPHS[kind], MADE[kind]
        header = Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=1)
        decoder.announce(
            Topology(header=header, nodes=len(row_start) - 1, row_start=row_start.tobytes(), columns=columns.tobytes())
        )
        decoder.add_pattern(key("pattern", worker="w", object=name), made.pattern.message(header).SerializeToString())
        values[name] = made.factorize(spd(*GRAPHS[kind], seed=place), np.float32)
        slot.part(place * ROOM, np.float32, len(values[name]))[:] = values[name]
        message.jobs.append(place + 1)
        message.patterns.append(made.pattern.id)
        message.nonzeros.append(len(values[name]))
        message.checksums.append(checksum(values[name]))
        message.seconds.append(0.25)
    batch = batch_in_flight(
        range(1, len(KINDS) + 1), list(KINDS), 1, 5, "float32", "w", 9.0, factor_slot=slot, factor_generation=3,
        first=np.arange(len(KINDS)) * ROOM, rooms=np.full(len(KINDS), ROOM),
    )  # fmt: skip
    return SimpleNamespace(decoder=decoder, slot=slot, message=message, batch=batch, values=values)
