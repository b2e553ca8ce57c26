# SPDX-License-Identifier: MIT
"""Memory in which factors are expanded: one set per device, as large as its largest user needs.

Expansions run one after another on one stream of the lowest priority, so they share it.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu.device import cupy


class Workspace:
    """staging: pinned, what goes to `incoming` on the device; memory: of the kernels. All bytes.

    generation counts how often any of them has moved: graphs hold addresses.
    """

    def __init__(self) -> None:
        cp = cupy()
        self.stream = cp.cuda.Stream(non_blocking=True, priority=0)  # 0 is the lowest
        self.generation = 0
        self.memory = self.incoming = cp.zeros(0, np.uint8)
        self._pinned: Any = None
        self.staging: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self.copied: Any = None  # event after which the staging may be written again

    def reserve(self, memory: int, incoming: int) -> None:
        """At least that many bytes, from now on. Without room for them it stays as large as it is, and CuPy's error is
        raised."""
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
    """Of a device, by its number, which is the current one."""
    return Workspace()
