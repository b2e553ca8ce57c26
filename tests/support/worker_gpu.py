# SPDX-License-Identifier: MIT
"""A stand-in for the GPU of a worker: device memory is the host's, copies are made at once, and a launch of the graph
runs what is given instead of kernels. It tells all that the host does.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

from precond_worker.gpu import gpu_factorization
from precond_worker.gpu.device import KERNELS
from precond_worker.gpu.plan import MultifrontalPlan

NONE = np.iinfo(np.int32).max
FOUND = NONE, NONE, 0  # status after a factorization of good matrices (multifrontal.cu)

# (plan, blocks of A, values of L, status (3,)); it writes the last two
Launch = Callable[[MultifrontalPlan, np.ndarray, np.ndarray, np.ndarray], None]


class Memory:
    """An array of the device."""

    def __init__(self, values: np.ndarray):
        self.held = values
        self.size, self.nbytes, self.data = values.size, values.nbytes, SimpleNamespace(ptr=values.ctypes.data)


class Stream:
    """A stream that has always done all. end_capture: returns the graph"""

    ptr = 1

    def __init__(self, end_capture: Callable[[], Any]):
        self.end_capture = end_capture

    def begin_capture(self) -> None: ...
    def synchronize(self) -> None: ...
    def __enter__(self) -> None: ...
    def __exit__(self, *error: object) -> None: ...


class WorkerGpu:
    """Stands for the module cupy. launch: called for each launch of the graph of a factorization"""

    def __init__(self, launch: Launch):
        self._launch = launch
        self.plans: dict[int, MultifrontalPlan] = {}  # by number of blocks
        self._arguments: dict[str, Any] = {}  # of the kernels of the graph that is being captured
        runtime = SimpleNamespace(
            memGetInfo=lambda: (1 << 40, 1 << 40), memcpyAsync=self.copy, memcpyDefault=4,
            CUDARuntimeError=type("CUDARuntimeError", (Exception,), {}),
        )  # fmt: skip
        self.cuda = SimpleNamespace(
            runtime=runtime, Stream=lambda **_: Stream(self._graph),
            memory=SimpleNamespace(OutOfMemoryError=MemoryError),
            Device=lambda: SimpleNamespace(synchronize=lambda: None), alloc_pinned_memory=self.pinned,
        )  # fmt: skip
        self.get_default_memory_pool = lambda: SimpleNamespace(free_bytes=lambda: 0)

    def copy(self, to: int, source: int, size: int, kind: int, stream: int) -> None:
        """In place of cudaMemcpyAsync."""
        ctypes.memmove(to, source, size)

    def pinned(self, size: int) -> np.ndarray:
        """Page-locked memory."""
        return np.full(size, 0x7F, np.uint8)

    def empty(self, *shape: Any) -> Memory:
        return Memory(np.empty(*shape))

    zeros = empty

    def asarray(self, values: np.ndarray) -> Memory:
        return Memory(np.array(values))

    def kernels(self, precision: str, stored: str) -> dict[str, Any]:
        """In place of device.kernels."""

        def kernel(name: str) -> Callable[..., None]:
            return lambda grid, block, arguments: self._arguments.__setitem__(name, arguments)

        return {name: kernel(name) for name in KERNELS}

    def _graph(self) -> Any:
        blocks, _, status = self._arguments["check_finite"]
        values = self._arguments["store"][4]
        plan = self.plans[blocks.size // 9]
        return SimpleNamespace(launch=lambda stream: self._launch(plan, blocks.held, values.held, status.held))


@contextmanager
def installed(gpu: WorkerGpu) -> Iterator[None]:
    """Context in which factorizations of a worker on a GPU are made with the stand-in."""

    def make_plan(*arguments: Any) -> MultifrontalPlan:
        plan = planned(*arguments)
        gpu.plans[plan.blocks] = plan
        return plan

    planned = gpu_factorization.make_plan
    instead = {
        "gpu_factorization.make_plan": make_plan, "gpu_factorization.try_out": lambda precision="auto": "stand-in",
        "gpu_factorization.name": lambda: "stand-in", "gpu_factorization.best_precision": lambda: "float64",
        "gpu_factorization.cupy": lambda: gpu, "executor.cupy": lambda: gpu, "executor.kernels": gpu.kernels,
    }  # fmt: skip
    with ExitStack() as patches:
        for name, function in instead.items():
            patches.enter_context(mock.patch(f"precond_worker.gpu.{name}", function))
        yield
