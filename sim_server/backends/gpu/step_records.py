# SPDX-License-Identifier: MIT
"""Records of steps, which the device writes into the ring of the host (step_records.cu)."""

import numpy as np

from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.structs import RECORDS, STEP_RECORDS, GpuLoop

THREADS: int = RECORDS.constant("THREADS")
TOGETHER: int = RECORDS.constant("TOGETHER")  # records that a thread block writes at a time
MOST_BLOCKS = 64  # far more than the bus to the host keeps busy


class StepRecords:
    """The kernel that writes records.

    results, energies: device rings (capacity, bodies) of PCG_RESULT and ENERGY_RECORD
    """

    def __init__(self, gpu: Gpu, results: DeviceArray, energies: DeviceArray, capacity: int, loop: GpuLoop):
        self._params = np.zeros((), STEP_RECORDS)
        self._params["results"], self._params["energies"] = results.data.ptr, energies.data.ptr
        self._params["records"], self._params["room"] = loop.records, loop.record_capacity
        self._params["capacity"], self._params["bodies"] = capacity, loop.bodies
        self._blocks = min(MOST_BLOCKS, -(-loop.bodies // TOGETHER) * 4)
        flags = (*options(gpu.types), *own_headers())
        module = gpu.cp.RawModule(code=RECORDS.checked(), options=flags, backend="nvrtc")
        self._kernel = compiled("step_records.cu", module, "write_records")

    def launch(self, target: int) -> None:
        """Appends the launch to the current stream. target: address of a RecordTarget in memory of the host"""
        params = self._params.copy()
        params["target"] = target
        self._kernel((self._blocks,), (THREADS,), (params,))
