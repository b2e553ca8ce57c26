# SPDX-License-Identifier: MIT
"""The GPU as the native loop sees it: CuPy's memory, streams and context, and the driver's functions by address."""

import ctypes as c
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu import structs
from sim_server.errors import DeviceError

FUNCTIONS = {
    "context_set": "cuCtxSetCurrent", "graph_launch": "cuGraphLaunch", "to_device": "cuMemcpyHtoDAsync_v2",
    "to_host": "cuMemcpyDtoHAsync_v2", "on_device": "cuMemcpyDtoDAsync_v2", "event_record": "cuEventRecord",
    "event_query": "cuEventQuery", "event_wait": "cuEventSynchronize", "stream_wait": "cuStreamWaitEvent",
}  # fmt: skip


class CudaDevice:
    """loop.LoopDevice on the current CUDA device. Raises DeviceError if the driver lacks a function."""

    def __init__(self, cp: Any):
        self.cp = cp
        try:
            self._driver = c.CDLL("libcuda.so.1")
            found = {name: getattr(self._driver, symbol) for name, symbol in FUNCTIONS.items()}
        except (OSError, AttributeError) as error:
            raise DeviceError(f"--device gpu: the NVIDIA driver is too old or not there: {error}") from error
        self.functions = structs.CudaDriver(**{name: c.cast(f, c.c_void_p) for name, f in found.items()})
        cp.cuda.runtime.free(0)  # makes CuPy's context the thread's
        context = c.c_void_p()
        self._driver.cuCtxGetCurrent(c.byref(context))
        self.context = context.value or 0
        self.steps = cp.cuda.Stream(non_blocking=True, priority=-5)
        self.home = cp.cuda.Stream(non_blocking=True, priority=-5)
        self.stream, self.copies = self.steps.ptr, self.home.ptr
        self._kept: list[Any] = []

    def pinned(self, size: int) -> NDArray[np.uint8]:
        """Page-locked host memory, zero."""
        memory = self.cp.cuda.alloc_pinned_memory(size)
        self._kept.append(memory)
        array = np.frombuffer(memory, np.uint8, size)
        array[:] = 0
        return array

    def memory(self, size: int) -> int:
        """Device memory, zero, there when this returns."""
        array = self.cp.zeros(size, np.uint8)
        self.cp.cuda.get_current_stream().synchronize()
        self._kept.append(array)
        return int(array.data.ptr)

    def event(self) -> int:
        """An event whose waiter sleeps."""
        event = self.cp.cuda.Event(block=True, disable_timing=True)
        self._kept.append(event)
        return int(event.ptr)

    def error(self, code: int) -> str:
        """Name and text of a driver error."""
        text = c.c_char_p()
        self._driver.cuGetErrorString(code, c.byref(text))
        return f"{(text.value or b'unknown').decode()} (CUDA error {code})"
