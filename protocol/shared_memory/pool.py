# SPDX-License-Identifier: MIT
"""Slots of shared memory that the server owns and lends to its workers.

A slot is one zenoh shared memory buffer in a segment of its own, mapped a second time so that NumPy writes it without
a copy; zenoh then sends it by reference. As the server owns every slot, a worker that dies leaks nothing. Each slot
begins with a header of 64 bytes with its generation, which grows each time it is lent.
"""

import mmap
import os
import secrets
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from numpy.typing import DTypeLike, NDArray
from zenoh import shm

from protocol.messages_pb2 import Slot as SlotMessage
from protocol.shared_memory import limits as shm_limits
from protocol.shared_memory.located import Located, address

HEADER = 64  # bytes; keeps the data aligned to a cache line
CACHE_LINE = shm.AllocAlignment(6)
MARK = 32  # bytes of the random mark by which a buffer is found in its segment
OVERHEAD = 1 << 16  # bytes of a segment for zenoh's own data
SMALLEST = 1 << 14  # bytes
RESERVE = 32 << 20  # bytes of /dev/shm left to others
LARGE = 2 << 20  # bytes of a slot that takes more than a few milliseconds to make, as its memory is cleared


class SlotsUnusable(Exception):
    """Shared memory does not work here; the text says why."""


class Slot:
    """One buffer. payload: as zenoh sends it. offset, capacity: of the data behind the header, in bytes."""

    def __init__(self, capacity: int):
        try:
            provider = shm.ShmProvider.default_backend((capacity + HEADER + OVERHEAD, CACHE_LINE))
            buffer = provider.alloc((capacity + HEADER, CACHE_LINE))
        except zenoh.ZError as error:
            raise SlotsUnusable(f"no shared memory segment of {capacity} bytes: {error}") from error
        mark = secrets.token_bytes(MARK)
        buffer[0:MARK] = mark
        self.segment, memory, start = _find(mark, capacity + HEADER)
        self._provider = provider  # the segment lives as long as this
        self.payload = zenoh.ZBytes(buffer)
        self.capacity = capacity
        self.offset = start + HEADER
        self._bytes = np.frombuffer(memory, np.uint8, capacity + HEADER, start)
        self._data = self._bytes[HEADER:].view(Located)
        self._address = address(self._data)
        self._generation = self._bytes[:8].view(np.uint64)
        self.generation = 0
        self.returned = 0  # when it was given back last, counted by the pool

    def lend(self) -> None:
        """Begins a new generation, by which late writes of an earlier borrower are recognized."""
        self.generation += 1
        self._generation[0] = self.generation

    def array(self, dtype: DTypeLike, count: int) -> NDArray[Any]:
        """Returns the first `count` values of the slot, in place."""
        return self.part(0, dtype, count)

    def part(self, first: int, dtype: DTypeLike, count: int) -> NDArray[Any]:
        """Returns `count` values from the byte `first` on, in place."""
        kind = np.dtype(dtype)
        found: Any = self._data[first : first + count * kind.itemsize].view(kind)
        found.address = self._address + first
        part: NDArray[Any] = found
        return part

    def message(self) -> SlotMessage:
        """Describes the slot for a borrower on this host."""
        return SlotMessage(segment=self.segment, offset=self.offset, capacity=self.capacity, generation=self.generation)


def _find(mark: bytes, size: int) -> tuple[str, mmap.mmap, int]:
    """Finds the segment of this process that holds the mark; returns its name, a mapping of it and the offset."""
    for path in _own_segments():
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            continue
        try:
            if os.fstat(fd).st_size < size:
                continue
            memory = mmap.mmap(fd, 0)
        finally:
            os.close(fd)
        start = memory.find(mark)
        if 0 <= start <= len(memory) - size:
            return path.name, memory, start
        memory.close()
    raise SlotsUnusable("a shared memory buffer of zenoh was not found under /dev/shm; its layout may have changed")


def _own_segments() -> Iterator[Path]:
    """Yields the segments of zenoh that this process maps, newest first."""
    words = (line.split() for line in Path("/proc/self/maps").read_text().splitlines())
    names = {
        parts[-1] for parts in words if parts[-1].startswith(f"{shm_limits.SHM}/") and parts[-1].endswith(".zenoh")
    }
    return iter(sorted(map(Path, names), key=_changed, reverse=True))


def _changed(path: Path) -> int:
    """Returns when a file was last written [ns]; 0 if it is gone, as a segment that is still mapped may be."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


class SlotPool:
    """Slots to lend, made when needed and used again. Its methods are for one thread at a time.

    limit: bytes of all slots
    """

    def __init__(self, limit: int = shm_limits.POOL_LIMIT):
        self.limit = limit
        self._thread = ThreadPoolExecutor(1, "slots")
        self._making: dict[Future[Slot], int] = {}  # in that thread, with their capacities
        self._unmade: set[int] = set()  # capacities that the thread could not make, until somebody was told
        self._free: dict[int, deque[Slot]] = {}  # by capacity, each the longest unused first
        self._lent: dict[int, int] = {}  # how many still use it, by id
        self._returns = 0
        self._live: set[Slot] = set()
        self._probe()

    def _probe(self) -> None:
        """Raises SlotsUnusable unless zenoh sends what NumPy writes."""
        slot = self.lend(1024)
        if slot is None:
            raise SlotsUnusable("/dev/shm is full")
        values = slot.array(np.uint8, 1024)
        values[:] = np.frombuffer(secrets.token_bytes(1024), np.uint8)
        if slot.payload.to_bytes()[HEADER : HEADER + 1024] != values.tobytes():
            raise SlotsUnusable(
                "zenoh does not see what is written into its shared memory; its layout may have changed"
            )
        self.give_back(slot)

    @property
    def bytes(self) -> int:
        """Bytes of all slots, lent or free, and of those that are being made."""
        return sum(slot.capacity for slot in self._live) + sum(self._making.values())

    @property
    def lent(self) -> int:
        """Number of slots lent now. A probe for tests."""
        return len(self._lent)

    def lend(self, size: int, users: int = 1, beside: bool = False) -> Slot | None:
        """Lends a slot for `size` bytes, in a new generation; returns None if there is no memory for it.

        users: it is free again once it was given back so many times
        beside: do not wait for a large one to be made: the first call begins to, and returns None. If that fails, the
            next call returns None without a further attempt, so that `is_making` tells
        """
        self._take_made()
        capacity = self._fitting(size)
        if capacity is None and beside and size > LARGE:
            if _rounded(size) in self._unmade:
                self._unmade.discard(_rounded(size))
            else:
                self.prepare(size)
            return None
        slot = self._make(_rounded(size)) if capacity is None else self._free[capacity].pop()
        if slot is not None:
            slot.lend()
            self._lent[id(slot)] = users
        return slot

    def prepare(self, size: int) -> None:
        """Begins to make a large slot for `size` bytes in a thread, unless one is free or being made; small ones are
        made when they are lent."""
        self._take_made()
        if size <= LARGE or self._fitting(size) is not None or self.is_making(size):
            return
        if self._make_room(capacity := _rounded(size)):
            self._making[self._thread.submit(Slot, capacity)] = capacity

    def is_making(self, size: int) -> bool:
        """True if a slot for so many bytes is being made in a thread."""
        return any(_fits(size, capacity) for capacity in self._making.values())

    @property
    def makes_any(self) -> bool:
        """True if a slot is being made in a thread."""
        return not all(making.done() for making in self._making)

    def _take_made(self) -> None:
        """Adds the slots that the thread has made to those that are free."""
        for future in [each for each in self._making if each.done()]:
            capacity = self._making.pop(future)
            try:
                slot = future.result()
            except (SlotsUnusable, OSError):
                self._unmade.add(capacity)
                continue
            self._unmade.discard(capacity)
            self._live.add(slot)
            self._put_back(slot)

    def _fitting(self, size: int) -> int | None:
        """Returns the smallest capacity of a free slot that fits."""
        return min((c for c, slots in self._free.items() if slots and _fits(size, c)), default=None)

    def give_back(self, slot: Slot, users: int = 1) -> None:
        """Takes a slot back from one of its users, or from several; a slot that is not lent is ignored."""
        lent = self._lent.pop(id(slot), 0)
        if lent > users:
            self._lent[id(slot)] = lent - users
        elif lent:
            self._put_back(slot)

    def _put_back(self, slot: Slot) -> None:
        self._returns += 1
        slot.returned = self._returns
        self._free.setdefault(slot.capacity, deque()).append(slot)

    def discard(self, slot: Slot) -> None:
        """Takes back a slot that its borrower may still write to: it is not lent again, its memory is freed."""
        if self._lent.pop(id(slot), None) is not None:
            self._live.discard(slot)

    def _make_room(self, capacity: int) -> bool:
        """Frees unused slots as long as there is no memory for another one; False if there is none then."""
        while not self._has_room(capacity) and (unused := [slots for slots in self._free.values() if slots]):
            oldest = min(unused, key=lambda slots: slots[0].returned)
            self._live.discard(oldest.popleft())  # its segment is freed with it
        return self._has_room(capacity)

    def _make(self, capacity: int) -> Slot | None:
        if not self._make_room(capacity):
            return None
        try:
            slot = Slot(capacity)
        except (SlotsUnusable, OSError):
            if not self._live:
                raise
            return None
        self._live.add(slot)
        return slot

    def _has_room(self, capacity: int) -> bool:
        return self.bytes + capacity <= self.limit and capacity + RESERVE <= shm_limits.free_bytes()

    def close(self) -> None:
        """Drops every slot; the segments are removed from /dev/shm."""
        self._thread.shutdown(cancel_futures=True)
        self._making.clear()
        self._free.clear()
        self._lent.clear()
        self._live.clear()


def _fits(size: int, capacity: int) -> bool:
    """True if a slot is large enough, and not far too large."""
    return size <= capacity <= 4 * max(size, SMALLEST)


def _rounded(size: int) -> int:
    """The next of 1, 1.25, 1.5 or 1.75 times a power of two, so that objects of much the same size share slots."""
    size = max(size, SMALLEST)
    quarter = 1 << (size.bit_length() - 3)
    return -(-size // quarter) * quarter
