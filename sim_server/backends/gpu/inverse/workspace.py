# SPDX-License-Identifier: MIT
"""Workspace in which inverses are built: one per device, as large as the largest build needs.

Builds share it, since they run one after another on one stream of the lowest priority.
"""

import threading
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu.cupy_types import DeviceArray, Event, Stream
from sim_server.backends.gpu.device import cupy


class Workspace:
    """Memory of the builds, in bytes.

    staging: pinned host memory that is copied to `incoming`
    incoming: device memory
    memory: device memory of the kernels
    generation: number of reallocations; graphs hold addresses of one generation
    copied: event after which `staging` may be written again, and the memory of `source` used again
    source: the values that are being copied, kept until the next ones are
    lock: held while memory is made or a build is begun, which several threads do
    """

    def __init__(self) -> None:
        cp = cupy()
        self.stream: Stream = cp.cuda.Stream(non_blocking=True, priority=0)  # 0 is the lowest
        self.generation = 0
        self.memory: DeviceArray = cp.zeros(0, np.uint8)
        self.incoming = self.memory
        self._pinned: Any = None
        self.staging: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self.copied: Event = cp.cuda.Event(block=True, disable_timing=True)
        self.source: list[Any] = []
        self.lock = threading.Lock()

    def reserve(self, memory: int, incoming: int) -> None:
        """Enlarges the workspace to at least these numbers of bytes.

        Raises CuPy's error, and leaves the workspace as it is, if there is too little memory.
        """
        with self.lock:
            self._reserve(memory, incoming)

    def _reserve(self, memory: int, incoming: int) -> None:
        cp = cupy()
        if memory <= self.memory.nbytes and incoming <= self.incoming.nbytes:
            return
        self.stream.synchronize()
        self.generation += 1
        if memory > self.memory.nbytes:
            before = self.memory.nbytes
            self.memory = cp.zeros(0, np.uint8)  # freed before the new one is made
            try:
                self.memory = cp.zeros(memory, np.uint8)
            except Exception:
                self.memory = cp.zeros(before, np.uint8)
                raise
        if incoming > self.incoming.nbytes:
            device, pinned = cp.zeros(incoming, np.uint8), cp.cuda.alloc_pinned_memory(incoming)
            self.incoming, self._pinned = device, pinned
            self.staging = np.frombuffer(self._pinned, np.uint8, incoming)
        cp.cuda.get_current_stream().synchronize()


@cache
def workspace(device: int) -> Workspace:
    """Returns the workspace of the current device, whose number is `device`."""
    return Workspace()
