# SPDX-License-Identifier: MIT
"""Holders on a GPU: their launches around the solve, and how the host gets the forces on them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers

TEXT = Declarations("backends/gpu/held.cu")
HELD_REACTIONS = TEXT.dtype("HeldReactions")
THREADS = 128


class HeldForces:
    """Launches what comes between the solve of a step and its integration.

    launches: which make the forces. reaction: (bodies, holders, 6), host array of a device one. results: host memory
    (capacity, bodies, holders, 6) that the steps write to. counter: completed steps
    """

    def __init__(
        self, gpu: Gpu, launches: Sequence[DeviceLaunch], reaction: Float64, results: NDArray[np.float64],
        counter: DeviceArray,
    ):  # fmt: skip
        self._launches, self._twin = launches, gpu.twin(reaction)
        self._params = np.zeros((), HELD_REACTIONS)
        self._params["from"], self._params["to"] = self._twin.data.ptr, results.ctypes.data
        self._params["step"] = counter.data.ptr
        self._params["numbers"], self._params["capacity"] = reaction.size, len(results)
        module = gpu.cp.RawModule(code=TEXT.checked(), options=(*options(gpu.types), *own_headers()), backend="nvrtc")
        self._report = compiled("held.cu", module, "report_held")

    def launch(self) -> None:
        """Appends the launches to the current stream."""
        for launch in self._launches:
            launch()
        self._report((-(-int(self._params["numbers"]) // THREADS),), (THREADS,), (self._params,))
