# SPDX-License-Identifier: MIT
"""Memory of the GPU that other processes can open (CUDA IPC): backends.shared_memory.SharedMemory of a real device."""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern, check_values
from protocol.refused import Refused
from protocol.validate import checksum
from sim_server.backends.gpu.cupy_types import DeviceArray, Stream
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.pinned import pinned_array
from sim_server.backends.shared_memory import Allocation, PlacedMatrix

SHARE = 8  # of the device's memory an eighth may be shared
KERNELS = {"float32": "check_float", "float64": "check_double"}
BLOCKS, THREADS = 4, 256  # of a check, on each multiprocessor
MOST_PATTERNS = 4  # whose diagonals are kept on the device


class SharedDeviceMemory:
    """Memory of the current device. Copies and checks run beside the steps, on a stream of the lowest priority.

    Raises CompileError.
    """

    def __init__(self, gpu: Gpu):
        cp, self.gpu = gpu.cp, gpu
        self.device, self.runtime = cp.cuda.Device(), cp.cuda.runtime
        self.limit = int(self.runtime.memGetInfo()[1]) // SHARE
        self.stream: Stream = cp.cuda.Stream(non_blocking=True, priority=0)
        self.sums, self._summing = False, ThreadPoolExecutor(1, "checksums of factors")
        self._lock = threading.Lock()  # of what follows
        module = gpu.module("backends/gpu/check_values.cu")
        self._functions = {dtype: module.function(kernel) for dtype, kernel in KERNELS.items()}
        self._wrong: DeviceArray = cp.zeros(2, np.int32)
        self.diagonals: dict[int, DeviceArray] = {}  # by id of the pattern, the one used last at the end
        cp.cuda.get_current_stream().synchronize()

    def allocate(self, size: int) -> Allocation | None:
        """Allocates memory for good; None if there is not enough, or no other process can open it."""
        self.device.use()
        free, total = self.runtime.memGetInfo()
        if size > free - total // SHARE:
            return None
        address = 0
        try:
            address = self.runtime.malloc(size)  # not of CuPy's pool, whose blocks hold other arrays, too
            handle = bytes(self.runtime.ipcGetMemHandle(address))
        except self.runtime.CUDARuntimeError:
            if address:
                self.runtime.free(address)
            return None
        return Allocation(handle, int(address))

    def read(self, address: int, count: int) -> NDArray[np.uint64]:
        """Copies numbers to the host."""
        found = np.zeros(count, np.uint64)
        self._copy(found.ctypes.data, address, found.nbytes)
        return found

    def write(self, address: int, values: NDArray[np.uint64]) -> None:
        """Copies numbers from the host."""
        self._copy(address, values.ctypes.data, values.nbytes)

    def put(self, address: int, matrices: Sequence[PlacedMatrix]) -> None:
        """Copies matrices one after another; they are there when this returns."""
        self.device.use()
        held = [each.values if each.on_device else np.ascontiguousarray(each.values) for each in matrices]
        for values, (_, on_device) in zip(held, matrices, strict=True):
            self._begin_copy(address, on_device or values.ctypes.data, values.nbytes)
            address += values.nbytes
        self.stream.record().synchronize()

    def take(self, address: int, pattern: FactorPattern, dtype: np.dtype[Any]) -> Any:
        """Returns a copy of the values of a factor (DeviceValues). Raises Refused unless they are finite and their
        diagonal is positive."""
        self.device.use()
        cp, count = self.gpu.cp, pattern.nonzeros
        with self._lock:
            try:
                made, diagonal = DeviceValues(cp.empty(count, dtype)), self._diagonal(pattern)
            except cp.cuda.memory.OutOfMemoryError:
                return self._taken_by_host(address, pattern, dtype)
            with self.stream:
                self._begin_copy(made.address, address, made.nbytes)
                self.runtime.memsetAsync(self._wrong.data.ptr, 0, self._wrong.nbytes, self.stream.ptr)
                blocks = min(-(-count // THREADS), BLOCKS * int(self.gpu.properties["multiProcessorCount"]))
                arguments = np.uint64(made.address), np.int64(count), diagonal, np.int32(pattern.size), self._wrong
                self._functions[dtype.name]((blocks,), (THREADS,), arguments)
                infinite, below = self._wrong.get(stream=self.stream).tolist()  # waits
        if infinite:
            raise Refused("Factor values hold NaN or infinite numbers; allowed: finite", "not_finite")
        if below:
            raise Refused("Factor values: a diagonal entry of L is not positive", "not_positive")
        if self.sums:
            made.sum = self._summing.submit(self._sum, made)
        return made

    def _taken_by_host(self, address: int, pattern: FactorPattern, dtype: np.dtype[Any]) -> NDArray[Any]:
        values = np.empty(pattern.nonzeros, dtype)
        self._copy(values.ctypes.data, address, values.nbytes)
        check_values(values, pattern, None)
        return values

    def _sum(self, values: DeviceValues) -> int:
        """Returns the checksum of values, in a thread."""
        self.device.use()
        stream = self.gpu.cp.cuda.Stream(non_blocking=True)
        host = pinned_array(self.gpu.cp, values.size, values.dtype)
        kind = self.runtime.memcpyDeviceToHost
        self.runtime.memcpyAsync(host.ctypes.data, values.address, host.nbytes, kind, stream.ptr)
        stream.synchronize()
        return checksum(host)

    def _diagonal(self, pattern: FactorPattern) -> DeviceArray:
        """Returns FactorPattern.diagonal on the device."""
        found = self.diagonals.pop(pattern.id, None)
        if found is None:
            found = self.gpu.cp.asarray(pattern.diagonal.astype(np.int64))
            self.gpu.cp.cuda.get_current_stream().synchronize()
        self.diagonals[pattern.id] = found
        while len(self.diagonals) > MOST_PATTERNS:
            del self.diagonals[next(iter(self.diagonals))]
        return found

    def _copy(self, to: int, source: int, size: int) -> None:
        self.device.use()
        self._begin_copy(to, source, size)
        self.stream.record().synchronize()

    def _begin_copy(self, to: int, source: int, size: int) -> None:
        self.runtime.memcpyAsync(to, source, size, self.runtime.memcpyDefault, self.stream.ptr)
