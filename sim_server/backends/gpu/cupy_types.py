# SPDX-License-Identifier: MIT
"""Types of what this package uses of CuPy, which is imported at run time only (device.cupy)."""

from types import TracebackType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


class Pointer(Protocol):
    """Address of device memory (cupy.cuda.MemoryPointer)."""

    ptr: int


class DeviceArray(Protocol):
    """An array in device memory (cupy.ndarray)."""

    data: Pointer
    dtype: np.dtype[Any]
    nbytes: int
    size: int
    shape: tuple[int, ...]

    def __len__(self) -> int: ...

    def __setitem__(self, index: Any, value: Any) -> None: ...

    def get(self, stream: "Stream | None" = None, *, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Copies the array to the host. out: to where; None: a new array"""
        ...

    def set(self, array: NDArray[Any]) -> None:
        """Copies a host array to the device."""
        ...


class Event(Protocol):
    """A point in a stream (cupy.cuda.Event)."""

    ptr: int

    def record(self, stream: "Stream") -> None:
        """Puts it behind what was appended to a stream."""
        ...

    def synchronize(self) -> None:
        """Waits until the stream has reached it."""
        ...


class Graph(Protocol):
    """Captured work of a stream (cupy.cuda.Graph). graphExec: its CUDA handle."""

    graphExec: int

    def launch(self, stream: "Stream") -> None:
        """Appends the work to a stream."""
        ...


class Stream(Protocol):
    """A queue of device work (cupy.cuda.Stream); the current one inside a `with` block."""

    ptr: int

    def __enter__(self) -> "Stream": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def synchronize(self) -> None:
        """Waits for all work that was appended."""
        ...

    def record(self) -> Event:
        """Appends a new event."""
        ...

    def wait_event(self, event: Event) -> None:
        """Has the work that follows wait for an event."""
        ...

    def begin_capture(self) -> None:
        """Records the work that follows in a graph instead of doing it."""
        ...

    def end_capture(self) -> Graph:
        """Returns the graph of the work since begin_capture."""
        ...


class KernelModule(Protocol):
    """A compiled text (cupy.RawModule)."""

    def get_function(self, name: str) -> "KernelFunction":
        """Returns a kernel by name."""
        ...


class KernelFunction(Protocol):
    """A compiled kernel (cupy.RawKernel)."""

    max_dynamic_shared_size_bytes: int

    def __call__(
        self, grid: tuple[int, ...], block: tuple[int, ...], args: tuple[Any, ...], *, shared_mem: int = 0
    ) -> None:
        """Appends a launch to the current stream."""
        ...
