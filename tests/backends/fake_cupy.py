# SPDX-License-Identifier: MIT
"""A stand-in for CuPy without a GPU: arrays are NumPy's, kernels are compiled by NVRTC and their calls counted.

What it cannot tell is what kernels compute; what it tells is whether a scene is built, each text compiles with the
options of a run, and each launch of a fused kernel has as many arguments as the kernel.
"""

import re
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from tests.backends.fake_cuda import FakeDevice
from tests.support import nvrtc

FUSED = r"\bfused\((int n[^)]*)\) \{"


class CompileException(Exception):
    """NVRTC refused a text."""


class Array(np.ndarray):
    """A device array."""

    @property
    def data(self) -> Any:  # type: ignore[override]
        return SimpleNamespace(ptr=self.ctypes.data)

    def get(self, stream: Any = None) -> np.ndarray:
        return np.array(self)

    def set(self, values: np.ndarray) -> None:
        self[...] = values


class Stream:
    """Does all at once."""

    ptr = 2

    def __init__(self, **options: Any):
        self.options = options

    def __enter__(self) -> None: ...
    def __exit__(self, *error: object) -> None: ...
    def synchronize(self) -> None: ...
    def begin_capture(self) -> None: ...

    def end_capture(self) -> Any:
        return SimpleNamespace(graphExec=7, launch=lambda stream: None)

    def record(self) -> Any:
        return SimpleNamespace(ptr=5, synchronize=lambda: None)


class Device(FakeDevice):
    """The driver's functions for the native loop, as CudaDevice offers them."""

    def __init__(self, cp: ModuleType):
        super().__init__()
        self.step_stream, self.copy_stream, self.graphs = Stream(), Stream(), {7: lambda: None}

    def branch(self, flag: Array) -> Any:
        return nullcontext()

    repeat = branch


def made(folder: Path, library: Any) -> ModuleType:
    """The module. Texts are compiled in `folder`.

    calls: (kernel, number of arguments) of each launch
    compiled: (text, options) of each module
    pending: arrays that were made since the host last waited for the current stream, and may not be there yet
    """
    cp: Any = ModuleType("cupy")
    cp.calls, cp.pending, cp.compiled = [], 0, set()
    compiled = cp.compiled

    class CurrentStream(Stream):
        def synchronize(self) -> None:
            cp.pending = 0

    def array(values: np.ndarray) -> np.ndarray:
        cp.pending += 1
        return values.view(Array)

    class Function:
        def __init__(self, kernel: str, arguments: int | None):
            self.kernel, self.arguments, self.max_dynamic_shared_size_bytes = kernel, arguments, 0

        def __call__(self, grid: Any, block: Any, arguments: Any, shared_mem: int = 0) -> None:
            assert self.arguments in (len(arguments), None), self.kernel
            cp.calls.append((self.kernel, len(arguments)))

    class RawModule:
        def __init__(self, code: str, options: Any = (), backend: str = "", enable_cooperative_groups: bool = False):
            self.code, self.options = code, tuple(options)

        def get_function(self, kernel: str) -> Function:
            if (self.code, self.options) not in compiled:
                text = folder / f"text{len(compiled)}.cu"
                text.write_text(self.code)
                code, said = nvrtc.compiled(library, text, ["-arch=sm_90", "--Ofast-compile=max", *self.options])
                if not code:
                    raise CompileException(said)
                compiled.add((self.code, self.options))
            found = re.search(FUSED, self.code) if kernel == "fused" else None
            return Function(kernel, found[1].count(",") + 1 if found else None)

    memory = {"memGetInfo": lambda: (1, 1), "memcpyAsync": lambda *a: None, "memsetAsync": lambda *a: None}
    properties = {
        "name": b"Fake", "multiProcessorCount": 132, "sharedMemPerMultiprocessor": 233472,
        "sharedMemPerBlockOptin": 232448,
    }  # fmt: skip
    cp.RawModule, cp.asarray = RawModule, lambda x: array(np.array(x))
    cp.zeros = lambda shape, dtype=np.float64: array(np.zeros(shape, dtype))
    cp.ones = lambda shape, dtype=np.float64: array(np.ones(shape, dtype))
    cp.full = lambda shape, value, dtype: array(np.full(shape, value, dtype))
    cp.empty_like = lambda like: array(np.empty_like(like))
    cp.cuda = SimpleNamespace(
        runtime=SimpleNamespace(
            getDeviceCount=lambda: 1, CUDARuntimeError=type("CUDARuntimeError", (RuntimeError,), {}),
            getDeviceProperties=lambda number: properties, memcpyDeviceToDevice=3, memcpyHostToDevice=1,
            runtimeGetVersion=lambda: 13000, **memory,
        ),
        Device=lambda *a: SimpleNamespace(id=0, compute_capability="90", attributes={"MultiProcessorCount": 132}),
        Stream=Stream, get_current_stream=CurrentStream, memory=SimpleNamespace(OutOfMemoryError=MemoryError),
        alloc_pinned_memory=lambda size: np.zeros(max(size, 1), np.uint8),
        compiler=SimpleNamespace(CompileException=CompileException),
    )  # fmt: skip
    return cp
