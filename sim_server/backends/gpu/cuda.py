# SPDX-License-Identifier: MIT
"""The CUDA device as the native GPU loop uses it: memory, streams and context of CuPy, functions of the driver."""

import ctypes as c
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu import structs
from sim_server.backends.gpu.conditions import Conditions, Loop
from sim_server.backends.gpu.cupy_types import DeviceArray, Event, KernelModule, Pointer, Stream
from sim_server.errors import DeviceError

FUNCTIONS = {
    "context_set": "cuCtxSetCurrent", "graph_launch": "cuGraphLaunch", "to_device": "cuMemcpyHtoDAsync_v2",
    "to_host": "cuMemcpyDtoHAsync_v2", "on_device": "cuMemcpyDtoDAsync_v2", "event_record": "cuEventRecord",
    "event_query": "cuEventQuery", "event_wait": "cuEventSynchronize", "stream_wait": "cuStreamWaitEvent",
}  # fmt: skip


@cache
def driver() -> c.CDLL:
    """Loads the CUDA driver. Raises DeviceError if there is none."""
    try:
        return c.CDLL("libcuda.so.1")
    except OSError as error:
        raise _too_old(error) from error


@cache
def driver_functions() -> structs.CudaDriver:
    """Returns the functions of the driver that native code calls. Raises DeviceError if it lacks one."""
    try:
        found = {name: getattr(driver(), symbol) for name, symbol in FUNCTIONS.items()}
    except AttributeError as error:
        raise _too_old(error) from error
    return structs.CudaDriver(**{name: c.cast(f, c.c_void_p) for name, f in found.items()})


def _too_old(error: Exception) -> DeviceError:
    return DeviceError(f"--device gpu: the NVIDIA driver is too old or not there: {error}")


class CudaDevice:
    """Implements loop.LoopDevice on the current CUDA device.

    step_stream: stream of the steps. copy_stream: stream of copies to the host.
    Raises DeviceError if the driver lacks a function.
    """

    def __init__(self, cp: Any):
        self.cp, self._driver, self.functions = cp, driver(), driver_functions()
        cp.cuda.runtime.free(0)  # makes CuPy's context current in this thread
        context = c.c_void_p()
        self._driver.cuCtxGetCurrent(c.byref(context))
        self.context = context.value or 0
        self.step_stream: Stream = cp.cuda.Stream(non_blocking=True, priority=-5)
        self.copy_stream: Stream = cp.cuda.Stream(non_blocking=True, priority=-5)
        self.stream, self.copies = self.step_stream.ptr, self.copy_stream.ptr
        self._kept: list[Pointer | DeviceArray | Event] = []

    def pinned(self, size: int) -> NDArray[np.uint8]:
        """Allocates page-locked host memory, set to zero."""
        memory = self.cp.cuda.alloc_pinned_memory(max(size, 1))
        self._kept.append(memory)
        array = np.frombuffer(memory, np.uint8, size)
        array[:] = 0
        return array

    def memory(self, size: int) -> int:
        """Allocates device memory and returns its address once it is set to zero."""
        array: DeviceArray = self.cp.zeros(size, np.uint8)
        self.cp.cuda.get_current_stream().synchronize()
        self._kept.append(array)
        return int(array.data.ptr)

    def event(self) -> int:
        """Creates an event; a thread that waits for it sleeps."""
        event: Event = self.cp.cuda.Event(block=True, disable_timing=True)
        self._kept.append(event)
        return int(event.ptr)

    @cached_property
    def _conditions(self) -> Conditions:
        return Conditions(self.cp, self._driver, self.context)

    @property
    def has_conditions(self) -> bool:
        """Whether the graphs of this driver have branches and loops."""
        try:
            return bool(self._conditions)
        except DeviceError:
            return False

    def branch(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs only if `flag` (1,) is not 0. Only while the current stream is captured.

        Raises DeviceError.
        """
        return self._conditions.branch(flag)

    def repeat(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs as long as `flag` (1,) is not 0, likewise."""
        return self._conditions.branch(flag, repeats=True)

    def loop(self) -> Loop:
        """Makes a loop of the graph that is captured now, see Conditions.loop. Raises DeviceError."""
        return self._conditions.loop()

    def linked(self, text: str, name: str, options: Sequence[str]) -> KernelModule:
        """Compiles a text whose kernels tell loops. options: of the compiler. Raises DeviceError."""
        return self._conditions.linked(text, name, options)

    def error(self, code: int) -> str:
        """Returns text and number of a driver error."""
        text = c.c_char_p()
        self._driver.cuGetErrorString(code, c.byref(text))
        return f"{(text.value or b'unknown').decode()} (CUDA error {code})"
