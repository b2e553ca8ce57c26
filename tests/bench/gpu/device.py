# SPDX-License-Identifier: MIT
"""The GPU of a run: what it is, what its memory and its barriers do, and the time of calls on it."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sim_server.backends.gpu.device import cupy

BARRIER = r"""
extern "C" __global__ void barriers(unsigned* arrived, double* partial, double* out, int count) {
    double sum = threadIdx.x;
    for (int k = 1; k <= count; ++k) {
        if (threadIdx.x == 0) {
            partial[blockIdx.x] = sum;
            asm volatile("red.release.gpu.global.add.u32 [%0], 1;" :: "l"(arrived) : "memory");
            unsigned seen;
            do asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(seen) : "l"(arrived) : "memory");
            while (seen < k * gridDim.x);
        }
        __syncthreads();
        sum += __ldcg(partial + (blockIdx.x + k) % gridDim.x);
    }
    if (sum == -1) *out = sum;
}
"""


def timed(call: Callable[[], Any], times: int) -> float:
    """us per call, launched one after another; one call beforehand."""
    cp = cupy()
    call()
    begin, end = cp.cuda.Event(), cp.cuda.Event()
    begin.record()
    for _ in range(times):
        call()
    end.record()
    end.synchronize()
    return 1e3 * cp.cuda.get_elapsed_time(begin, end) / times


def timed_in_graph(call: Callable[[], Any], times: int) -> float:
    """us per call of `times` calls in one CUDA graph: without what their launches cost the host."""
    cp = cupy()
    stream = cp.cuda.Stream(non_blocking=True)
    with stream:
        call()
        stream.synchronize()
        stream.begin_capture()
        for _ in range(times):
            call()
        graph = stream.end_capture()
        graph.launch(stream)
        begin, end = cp.cuda.Event(), cp.cuda.Event()
        begin.record(stream)
        graph.launch(stream)
        end.record(stream)
        end.synchronize()
    return 1e3 * cp.cuda.get_elapsed_time(begin, end) / times


def copy_bandwidth(megabytes: int = 1024) -> float:
    """TB/s, read and written, of a copy within the device's memory."""
    cp = cupy()
    source = cp.zeros(megabytes << 17)
    target = cp.empty_like(source)
    best = min(timed(lambda: cp.copyto(target, source), 4) for _ in range(3))
    return 2 * source.nbytes / best / 1e6


def barrier() -> float:
    """us of one step of a persistent kernel on all processors: barrier, store before it, dependent load after it."""
    cp = cupy()
    kernel = cp.RawModule(code=BARRIER, backend="nvrtc", enable_cooperative_groups=True).get_function("barriers")
    grid = cp.cuda.runtime.getDeviceProperties(cp.cuda.Device().id)["multiProcessorCount"]
    arrived, partial = cp.zeros(1, np.uint32), cp.zeros(grid + 1)

    def run(count: int) -> float:
        def launch() -> None:
            arrived.fill(0)
            kernel((grid,), (512,), (arrived, partial, partial[grid:], np.int32(count)))

        return min(timed(launch, 3) for _ in range(3))

    return (run(2200) - run(200)) / 2000


def described() -> dict[str, Any]:
    """Name, driver, versions, and the figures measured here."""
    cp = cupy()
    properties = cp.cuda.runtime.getDeviceProperties(cp.cuda.Device().id)
    return {
        "gpu": properties["name"].decode(),
        "processors": int(properties["multiProcessorCount"]),
        "driver": _driver(),
        "CUDA": _version(cp.cuda.runtime.runtimeGetVersion()),
        "cupy": cp.__version__,
        "copy TB/s": copy_bandwidth(),
        "barrier us": barrier(),
    }


def _version(number: int) -> str:
    return f"{number // 1000}.{number % 1000 // 10}"


def _driver() -> str:
    import subprocess

    try:
        command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        return subprocess.run(command, capture_output=True, text=True).stdout.split("\n")[0].strip() or "unknown"
    except OSError:
        return "unknown"
