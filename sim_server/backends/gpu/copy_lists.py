# SPDX-License-Identifier: MIT
"""Copies that the device makes in one launch, as lists say (copy_list.cu)."""

import numpy as np

from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers, processors
from sim_server.backends.gpu.structs import COPIES, CopyLaunch

THREADS: int = COPIES.constant("THREADS")
BLOCKS = 4  # of a launch, on each multiprocessor


class ListedCopies:
    """The kernel that makes them."""

    def __init__(self, gpu: Gpu):
        flags = (*options(gpu.types), *own_headers())
        module = gpu.cp.RawModule(code=COPIES.checked(), options=flags, backend="nvrtc")
        self._kernel, self._blocks = compiled("copy_list.cu", module, "make_copies"), BLOCKS * processors()

    def launch(self, made: CopyLaunch) -> None:
        """Appends the launch to the current stream. made: where the list is"""
        self._kernel((self._blocks,), (THREADS,), (np.uint64(made.target),))
