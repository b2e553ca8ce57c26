# SPDX-License-Identifier: MIT
"""Slots of another process, mapped here by their borrower."""

import mmap
import os
import re
import stat
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from protocol.messages_pb2 import Slot as SlotMessage
from protocol.refused import Refused
from protocol.shared_memory.limits import SHM
from protocol.shared_memory.pool import HEADER

SEGMENT = re.compile(r"[0-9]{1,24}\.zenoh")
MAPPED = 64  # segments kept mapped


class SlotMap:
    """Arrays in slots that messages describe. The descriptions are not trusted."""

    def __init__(self) -> None:
        self._memory: OrderedDict[str, mmap.mmap] = OrderedDict()

    def array(self, slot: SlotMessage, dtype: DTypeLike, count: int) -> NDArray[Any]:
        """Returns the first `count` values of the slot, in place; raises Refused."""
        kind = np.dtype(dtype)
        if count * kind.itemsize > slot.capacity:
            raise Refused(
                f"Slot.capacity is {slot.capacity} bytes; needed: {count * kind.itemsize} for {count} {kind.name}",
                "slot",
            )
        return np.frombuffer(self._map(slot), kind, count, slot.offset)

    def is_current(self, slot: SlotMessage) -> bool:
        """True if the slot was not lent again since the message was sent."""
        generation = np.frombuffer(self._map(slot), np.uint64, 1, slot.offset - HEADER)
        return int(generation[0]) == slot.generation

    def _map(self, slot: SlotMessage) -> mmap.mmap:
        memory = self._memory.get(slot.segment)
        if memory is None:
            memory = self._memory[slot.segment] = _open(slot.segment)
            while len(self._memory) > MAPPED:
                self._memory.popitem(last=False)  # unmapped with the last array in it
        self._memory.move_to_end(slot.segment)
        if slot.offset % 8 or not HEADER <= slot.offset <= len(memory) - slot.capacity:
            raise Refused(
                f"Slot.offset is {slot.offset} with {slot.capacity} bytes in a segment of {len(memory)}; allowed: "
                f"inside, a multiple of 8, {HEADER} or more",
                "slot",
            )
        return memory

    def clear(self) -> None:
        """Drops all segments, when their server is gone."""
        self._memory.clear()


def _open(segment: str) -> mmap.mmap:
    if not SEGMENT.fullmatch(segment):
        raise Refused(f"Slot.segment is {segment[:80]!r}; allowed: digits and .zenoh", "slot")
    try:
        fd = os.open(SHM / segment, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError as error:
        raise Refused(f"Slot.segment {segment} cannot be opened: {error.strerror}", "slot") from error
    try:
        info = os.fstat(fd)
        if not stat.S_ISREG(info.st_mode) or info.st_uid != os.geteuid() or info.st_size == 0:
            raise Refused(f"Slot.segment {segment} is not a file of this user", "slot")
        return mmap.mmap(fd, 0)
    finally:
        os.close(fd)
