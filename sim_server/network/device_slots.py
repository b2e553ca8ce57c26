# SPDX-License-Identifier: MIT
"""Slots of device memory that the server lends to workers beside it, which open them: the matrix of a large body is
copied there within the device, and its factor is copied from there.

The server owns every slot, so a worker that dies takes none away. What a worker may write is copied before it is
looked at (`SharedMemory.take`).
"""

import logging
import secrets
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from protocol.channels import PROTOCOL
from protocol.counters import Counters
from protocol.messages_pb2 import DeviceSlot as DeviceSlotMessage
from protocol.messages_pb2 import Echo, Header
from protocol.shared_memory.device_probe import DEVICE_HEADER, NUMBER
from protocol.shared_memory.probe import LANES, NUMBERS
from sim_server.backends.shared_memory import SharedMemory

log = logging.getLogger(__name__)

RETRY = 1.0  # s after a failed allocation in which none is tried, doubled with each one in a row
MAX_DOUBLINGS = 6
UNIT = 2 << 20  # bytes; allocations are multiples: a driver shares whole pages of this size


@dataclass(eq=False)
class DeviceSlot:
    """A slot. capacity: bytes from `address` on"""

    handle: bytes
    address: int
    capacity: int
    generation: int = 0

    def message(self) -> DeviceSlotMessage:
        """Describes the slot for a borrower on this host."""
        return DeviceSlotMessage(handle=self.handle, capacity=self.capacity, generation=self.generation)


class DeviceSlots:
    """Slots to lend, made in a thread when they are wanted first, and used again. For one thread at a time, unless said
    otherwise; `lend` and `prepare` do not wait for the device.

    counters: of allocations that failed; None: its own
    """

    def __init__(self, memory: SharedMemory, counters: Counters | None = None):
        self.memory, self._counters = memory, Counters(log) if counters is None else counters
        self._thread = ThreadPoolExecutor(1, "device slots")
        self._making: dict[Future[DeviceSlot | None], int] = {}  # with their capacities
        self._slots: list[DeviceSlot] = []
        self._lent: set[int] = set()  # ids
        self._failed, self._retry_at = 0, 0.0  # allocations in a row; time [s, monotonic] of the next one
        self._probe: DeviceSlot | None = None
        try:
            probe = self._made(UNIT)
            if probe is not None:
                self.mark(probe, probe.generation)
            self._probe = probe
        except Exception as error:  # of the driver
            self._on_failure(error)

    @property
    def usable(self) -> bool:
        """False if this process cannot share device memory."""
        return self._probe is not None

    @property
    def lent(self) -> int:
        """Number of slots lent now. A probe for tests."""
        return len(self._lent)

    @property
    def bytes(self) -> int:
        """Bytes of all slots, and of those that are being made."""
        return sum(slot.capacity + DEVICE_HEADER for slot in self._slots) + sum(self._making.values())

    @property
    def makes_any(self) -> bool:
        """True if a slot is being made in a thread."""
        return not all(making.done() for making in self._making)

    def lend(self, sizes: Sequence[int]) -> list[DeviceSlot] | None:
        """Lends a slot for each of some numbers of bytes, in new generations; None if one is not there (yet)."""
        chosen = self._chosen(sizes)
        for slot in chosen or ():
            self._lent.add(id(slot))
            slot.generation += 1
        return chosen

    def prepare(self, sizes: Sequence[int]) -> None:
        """Begins to make those slots for some numbers of bytes that are neither free nor being made."""
        self._chosen(sizes)

    def _chosen(self, sizes: Sequence[int]) -> list[DeviceSlot] | None:
        """Returns a free slot for each of some numbers of bytes; None if one is not there, which is then being made."""
        self._take_made()
        chosen: list[DeviceSlot] = []
        missing: list[int] = []
        for size in sizes:
            free = [s for s in self._slots if id(s) not in self._lent and s not in chosen and _fits(size, s.capacity)]
            if free:
                chosen.append(min(free, key=lambda slot: slot.capacity))
            else:
                missing.append(_rounded(size))
        for whole in missing:
            self._begin_making(whole, missing.count(whole))
        return None if missing else chosen

    def _begin_making(self, whole: int, most: int) -> None:
        """Begins to make a slot of so many bytes, unless as many are being made or the limit is reached."""
        enough = list(self._making.values()).count(whole) >= most
        waits = self._failed and time.monotonic() < self._retry_at
        if not (enough or waits) and self.usable and self.bytes + whole <= self.memory.limit:
            self._making[self._thread.submit(self._made, whole)] = whole

    def give_back(self, slot: DeviceSlot, users: int = 1) -> None:
        """Takes a slot back, which one job used; one that is not lent is ignored."""
        self._lent.discard(id(slot))

    def mark(self, slot: DeviceSlot, generation: int) -> None:
        """Writes the generation in which a slot is lent into it, by which a worker sees that it was lent again since.
        From any thread."""
        self.memory.write(slot.address - DEVICE_HEADER, np.array([generation], NUMBER))

    def _take_made(self) -> None:
        for future in [each for each in self._making if each.done()]:
            del self._making[future]
            try:
                slot = future.result()
            except Exception as error:  # of the driver; what would be there travels through shared memory
                self._on_failure(error)
                continue
            if slot is None:
                self._on_failure("no more is left")
                continue
            self._failed = 0
            self._slots.append(slot)

    def _on_failure(self, error: Exception | str) -> None:
        """Takes note of an allocation that failed: of memory that is used up, or of a driver that makes no more."""
        self._retry_at = time.monotonic() + RETRY * 2 ** min(self._failed, MAX_DOUBLINGS)
        self._failed += 1
        self._counters.trouble("device_slots", f"device memory for matrices and factors is not there: {error}")

    def _made(self, whole: int) -> DeviceSlot | None:
        found = self.memory.allocate(whole)
        if found is None:
            return None
        first = secrets.randbits(32)  # a generation of memory that another server had is none of this one
        return DeviceSlot(found.handle, found.address + DEVICE_HEADER, whole - DEVICE_HEADER, first)

    def answer(self, query: Echo, incarnation: int) -> Echo:
        """Returns the reply to a question about device memory (shared_memory/device_probe.py). From any thread."""
        header = Header(protocol=PROTOCOL, incarnation=incarnation, sequence=query.header.sequence)
        if self._probe is None:
            return Echo(header=header)
        lane, at = query.header.sequence % LANES, self._probe.address
        assert NUMBER.itemsize * NUMBERS <= self._probe.capacity
        self.memory.write(at + NUMBER.itemsize * lane, np.array([query.nonce], NUMBER))
        told = self.memory.read(at + NUMBER.itemsize * (LANES + lane), 1)
        return Echo(header=header, device=self._probe.message(), nonce=int(told[0]))

    def close(self) -> None:
        """Makes no more slots."""
        self._thread.shutdown(cancel_futures=True)


def _rounded(size: int) -> int:
    """Bytes of an allocation for a slot: with the next of 1, 1.25, 1.5 or 1.75 times a power of two, so that factors of
    a body that is cut find room in the one before."""
    size = max(size, UNIT // 2)
    quarter = 1 << (size.bit_length() - 3)
    return -(-(-(-size // quarter) * quarter + DEVICE_HEADER) // UNIT) * UNIT


def _fits(size: int, capacity: int) -> bool:
    """True if a slot is large enough, and not far too large."""
    return size <= capacity <= max(4 * size, UNIT)
