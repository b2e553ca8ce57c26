# SPDX-License-Identifier: MIT
"""Device memory of servers beside this worker, opened by the handles in their messages (CUDA IPC), which are not
trusted."""

import ctypes as c
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.gpu.device import cupy
from protocol.messages_pb2 import DeviceSlot
from protocol.process.nvidia import first_line
from protocol.refused import Refused
from protocol.shared_memory.device_probe import DEVICE_HEADER, HANDLE, NUMBER

OPENED = 64  # allocations kept open


class OpenedDeviceMemory:
    """Implements device_probe.OpenedMemory on the current device. Methods may be called from any thread, and wait."""

    def __init__(self) -> None:
        cp = cupy()
        self.runtime, self._driver = cp.cuda.runtime, c.CDLL("libcuda.so.1")
        self.device = cp.cuda.Device()
        self.stream = cp.cuda.Stream(non_blocking=True)
        self._opened: OrderedDict[bytes, tuple[int, int]] = OrderedDict()  # address and size, by handle

    def address(self, slot: DeviceSlot, size: int) -> int:
        """Returns where the data of a slot begin, of which at least `size` bytes are needed; raises Refused."""
        if len(slot.handle) != HANDLE:
            raise Refused(f"DeviceSlot.handle has {len(slot.handle)} bytes; allowed: {HANDLE}", "slot")
        if size > slot.capacity:
            raise Refused(f"DeviceSlot.capacity is {slot.capacity} bytes; needed: {size}", "slot")
        base, whole = self._open(slot.handle)
        if slot.capacity > whole - DEVICE_HEADER:
            raise Refused(
                f"DeviceSlot.capacity is {slot.capacity} bytes; allowed: {whole - DEVICE_HEADER}, as allocated", "slot"
            )
        return base + DEVICE_HEADER

    def _open(self, handle: bytes) -> tuple[int, int]:
        found = self._opened.get(handle)
        if found is None:
            self.device.use()
            try:
                address = int(self.runtime.ipcOpenMemHandle(handle))
            except (self.runtime.CUDARuntimeError, ValueError) as error:
                raise Refused(f"DeviceSlot.handle cannot be opened: {first_line(error)}", "slot") from error
            base, size = c.c_uint64(), c.c_size_t()
            told = self._driver.cuMemGetAddressRange_v2(c.byref(base), c.byref(size), c.c_uint64(address))
            if told or base.value != address:
                self.runtime.ipcCloseMemHandle(address)
                raise Refused("DeviceSlot.handle is of memory whose size cannot be told", "slot")
            found = self._opened[handle] = address, size.value
            while len(self._opened) > OPENED:
                self._close(self._opened.popitem(last=False)[1])
        self._opened.move_to_end(handle)
        return found

    def is_current(self, slot: DeviceSlot) -> bool:
        """True if the slot was not lent again since the message was sent."""
        return int(self.read(self.address(slot, 0) - DEVICE_HEADER, NUMBER, 1)[0]) == slot.generation

    def read(self, address: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """Copies numbers to the host."""
        found = np.empty(count, dtype)
        self._copy(found.ctypes.data, address, found.nbytes)
        return found

    def write(self, address: int, values: NDArray[Any]) -> None:
        """Copies numbers from the host; they are there when it returns."""
        self._copy(address, values.ctypes.data, values.nbytes)

    def _copy(self, to: int, source: int, size: int) -> None:
        self.device.use()
        try:
            self.runtime.memcpyAsync(to, source, size, self.runtime.memcpyDefault, self.stream.ptr)
            self.stream.synchronize()
        except self.runtime.CUDARuntimeError as error:
            raise Refused(f"DeviceSlot cannot be copied from or to: {first_line(error)}", "slot") from error

    def clear(self) -> None:
        """Closes all memory, when its server is gone."""
        while self._opened:
            self._close(self._opened.popitem()[1])

    def _close(self, opened: tuple[int, int]) -> None:
        self.device.use()
        try:
            self.runtime.ipcCloseMemHandle(opened[0])
        except self.runtime.CUDARuntimeError:  # the process that owned it may be gone
            return
