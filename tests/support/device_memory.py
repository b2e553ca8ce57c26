# SPDX-License-Identifier: MIT
"""Stands for device memory of a server and for CUDA IPC: files in shared memory, which others map by their names.

Addresses are those of the mappings, which differ between processes as those of a device do.
"""

import ctypes as c
import mmap
import os
import secrets
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern, check_values
from protocol.messages_pb2 import DeviceSlot
from protocol.refused import Refused
from protocol.shared_memory.device_probe import DEVICE_HEADER, HANDLE, NUMBER
from sim_server.backends.shared_memory import Allocation, PlacedMatrix

FOLDER = Path("/dev/shm")
PREFIX = "warpfactor-test-"


def _mapped(path: Path) -> tuple[mmap.mmap, int]:
    """A mapping of a file, and its address."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        memory = mmap.mmap(descriptor, 0)
    finally:
        os.close(descriptor)
    return memory, int(np.frombuffer(memory, np.uint8).ctypes.data)


def numbers(address: int, dtype: Any, count: int) -> NDArray[Any]:
    """An array in place."""
    kind = np.dtype(dtype)
    return np.frombuffer((c.c_char * (count * kind.itemsize)).from_address(address), kind)


class StandInMemory:
    """backends.shared_memory.SharedMemory.

    taken: values that were taken. matrices: whether each matrix was told to be on the device
    """

    def __init__(self, limit: int = 64 << 20):
        self.limit, self.sums, self._kept = limit, False, list[mmap.mmap]()
        self.paths: list[Path] = []
        self.taken: list[NDArray[Any]] = []

    def allocate(self, size: int) -> Allocation | None:
        path = FOLDER / (PREFIX + secrets.token_hex(8))
        with path.open("xb") as file:
            file.truncate(size)
        self.paths.append(path)
        memory, address = _mapped(path)
        self._kept.append(memory)
        return Allocation(path.name.encode().ljust(HANDLE, b"\0"), address)

    def read(self, address: int, count: int) -> NDArray[np.uint64]:
        return numbers(address, np.uint64, count).copy()

    def write(self, address: int, values: NDArray[np.uint64]) -> None:
        numbers(address, np.uint64, len(values))[:] = values

    def put(self, address: int, matrices: Sequence[PlacedMatrix]) -> None:
        for values, _ in matrices:
            numbers(address, np.float64, values.size)[:] = values.ravel()
            address += values.nbytes

    def take(self, address: int, pattern: FactorPattern, dtype: np.dtype[Any]) -> NDArray[Any]:
        values = numbers(address, dtype, pattern.nonzeros).copy()
        check_values(values, pattern, None)
        self.taken.append(values)
        return values

    def close(self) -> None:
        """Removes the files."""
        for path in self.paths:
            with suppress(FileNotFoundError):
                path.unlink()


class OpenedStandIn:
    """device_probe.OpenedMemory."""

    def __init__(self) -> None:
        self._opened: dict[bytes, tuple[mmap.mmap, int]] = {}

    def address(self, slot: DeviceSlot, size: int) -> int:
        name = slot.handle.rstrip(b"\0").decode(errors="replace")
        if len(slot.handle) != HANDLE or not name.startswith(PREFIX) or "/" in name:
            raise Refused(f"DeviceSlot.handle is {name!r}", "slot")
        if slot.handle not in self._opened:
            try:
                self._opened[slot.handle] = _mapped(FOLDER / name)
            except OSError as error:
                raise Refused(f"DeviceSlot.handle cannot be opened: {error}", "slot") from error
        memory, address = self._opened[slot.handle]
        if not size <= slot.capacity <= len(memory) - DEVICE_HEADER:
            raise Refused(f"DeviceSlot.capacity is {slot.capacity}, needed {size}", "slot")
        return address + DEVICE_HEADER

    def is_current(self, slot: DeviceSlot) -> bool:
        return int(self.read(self.address(slot, 0) - DEVICE_HEADER, NUMBER, 1)[0]) == slot.generation

    def read(self, address: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        return numbers(address, dtype, count).copy()

    def write(self, address: int, values: NDArray[Any]) -> None:
        numbers(address, values.dtype, values.size)[:] = values.ravel()

    def clear(self) -> None:
        self._opened.clear()
