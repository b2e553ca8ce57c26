# SPDX-License-Identifier: MIT
"""How the host gets the numbers that effects leave in each step (backends/measured.py) from a GPU."""

from collections.abc import Sequence

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.measured import Measured

TEXT = Declarations("backends/gpu/measured.cu")
MEASURED_NUMBERS = TEXT.dtype("MeasuredNumbers")
THREADS = 128


class MeasuredReport:
    """One launch behind each step.

    results: host memory (capacity, numbers) that it writes to. counter: completed steps
    """

    def __init__(self, gpu: Gpu, measured: Sequence[Measured], results: Float64, counter: DeviceArray):
        twins = [gpu.twin(m.array) for m in measured]
        addresses = [int(t.data.ptr) + t.dtype.itemsize * m.index for t, m in zip(twins, measured, strict=True)]
        self._from: DeviceArray = gpu.cp.asarray(np.array(addresses, np.uint64))
        self._params = np.zeros((), MEASURED_NUMBERS)
        self._params["from"], self._params["to"] = self._from.data.ptr, results.ctypes.data
        self._params["step"] = counter.data.ptr
        self._params["numbers"], self._params["capacity"] = len(measured), len(results)
        module = gpu.cp.RawModule(code=TEXT.checked(), options=(*options(gpu.types), *own_headers()), backend="nvrtc")
        self._report = compiled("measured.cu", module, "report_measured")

    def launch(self) -> None:
        """Appends the launch to the current stream."""
        self._report((-(-int(self._params["numbers"]) // THREADS),), (THREADS,), (self._params,))
