# SPDX-License-Identifier: MIT
"""What workers send, checked before it is believed: patterns, and factors as values or in a lent slot."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.channels import CHANNELS, name_in
from protocol.check import Sized, array, check_header, check_numbers, check_strings, parse, take
from protocol.factor import Factor, FactorPattern, check_values
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.messages_pb2 import FactorPattern as PatternMessage
from protocol.messages_pb2 import Topology
from protocol.refused import Refused
from sim_server.network.leases import InFlightJob

PATTERNS = 4  # kept per object: one per library among its workers


@dataclass
class AnnouncedObject:
    """What the server knows of one object in its present epoch."""

    epoch: int
    size: int  # degrees of freedom
    blocks: int
    patterns: dict[int, FactorPattern] = field(default_factory=dict)
    largest: dict[str, int] = field(default_factory=dict)  # values of the largest factor so far, by method


class FactorDecoder:
    """Checks of messages from workers against the objects that were announced."""

    def __init__(self, incarnation: int):
        self._incarnation = incarnation
        self.known: dict[str, AnnouncedObject] = {}

    def announce(self, topology: Topology) -> None:
        """A new epoch of an object begins; patterns of the last one are forgotten."""
        header = topology.header
        self.known[header.object] = AnnouncedObject(header.epoch, 3 * topology.nodes, len(topology.columns) // 4)

    def take_pattern(self, key: object, data: Sized) -> None:
        """A pattern that a worker found; raises Refused."""
        message = parse(PatternMessage, data, CHANNELS["pattern"].limit)
        known = self._object(message, key, "pattern")
        check_header(message, epoch=known.epoch)
        if message.size != known.size:
            raise Refused(f"FactorPattern.size is {message.size}; allowed: {known.size}", "shape")
        pattern = FactorPattern.from_message(message)
        if pattern.id not in known.patterns:
            while len(known.patterns) >= PATTERNS:
                known.patterns.pop(next(iter(known.patterns)))
            known.patterns[pattern.id] = pattern

    def parse_factor(self, key: object, attachment: Sized | None) -> FactorMessage:
        """The message beside the values, for this life of the server and an object of it; raises Refused.

        Its epoch is not looked at: also the answer to a job of the last epoch tells that its worker is free again.
        """
        message = parse(FactorMessage, attachment, CHANNELS["factor"].limit)
        self._object(message, key, "factor")
        check_strings(message)
        check_numbers(message)
        if message.seconds < 0:
            raise Refused(f"Factor.seconds is {message.seconds}; allowed: 0 or more", "malformed")
        return message

    def factor(self, message: FactorMessage, payload: Sized, flight: InFlightJob) -> Factor:
        """The factor that answers a flight; raises Refused."""
        for name, value, wanted in (
            ("header.object", message.header.object, flight.object),
            ("step", message.step, flight.step),
            ("warp", message.warp, flight.warp),
            ("dtype", message.dtype, flight.dtype),
        ):
            if value != wanted:
                raise Refused(f"Factor.{name} is {value!r}; allowed: {wanted!r}, as in the matrix", "malformed")
        pattern = self.known[flight.object].patterns.get(message.pattern)
        if pattern is None:
            raise Refused(f"Factor.pattern is {message.pattern:016x}, which was not sent before", "pattern")
        if message.nonzeros != pattern.nonzeros:
            raise Refused(f"Factor.nonzeros is {message.nonzeros}; allowed: {pattern.nonzeros}", "shape")
        slotted = message.HasField("slot")
        values = _from_slot(message, flight) if slotted else _from_payload(message, payload)
        check_values(values, pattern, message.checksum)
        largest = self.known[flight.object].largest
        largest[flight.method] = max(largest.get(flight.method, 0), pattern.nonzeros)
        return Factor(
            flight.object, flight.epoch, flight.step, flight.warp, pattern, values, flight.worker, message.seconds,
            message.remedy[:200],
        )  # fmt: skip

    def _object(self, message: Any, key: object, channel: str) -> AnnouncedObject:
        header = check_header(message, incarnation=self._incarnation, object=self.known)
        if header.object != name_in(channel, key, "object"):
            raise Refused(f"{message.DESCRIPTOR.name}.header.object is {header.object!r}, its key is {key}", "object")
        return self.known[header.object]


def _from_slot(message: FactorMessage, flight: InFlightJob) -> NDArray[Any]:
    """A copy of the values in the slot lent for this job: what is checked must not change any more."""
    slot = flight.factor_slot
    if slot is None:
        raise Refused("Factor.slot is set, but no slot was lent for this job", "slot")
    given = (message.slot.segment, message.slot.offset, message.slot.generation)
    lent = (slot.segment, slot.offset, flight.factor_generation)
    if given != lent:
        raise Refused(f"Factor.slot is {given}; allowed: {lent}, as lent for this job", "slot")
    size = message.nonzeros * np.dtype(flight.dtype).itemsize
    if size > slot.capacity:
        raise Refused(f"Factor.nonzeros is {message.nonzeros}: {size} bytes in a slot of {slot.capacity}", "slot")
    return slot.array(flight.dtype, message.nonzeros).copy()


def _from_payload(message: FactorMessage, payload: Sized) -> NDArray[Any]:
    dtype = np.dtype(message.dtype)
    size = message.nonzeros * dtype.itemsize
    if len(payload) != size:
        raise Refused(f"Factor payload has {len(payload)} bytes; allowed: {size}", "size")
    return array(take(payload, CHANNELS["factor"].bulk, "Factor payload"), dtype, (-1,), "Factor payload")
