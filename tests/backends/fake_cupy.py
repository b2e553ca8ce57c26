# SPDX-License-Identifier: MIT
"""A stand-in for CuPy without a GPU: arrays are NumPy's, kernels are compiled by NVRTC and their calls counted.

What it cannot tell is what kernels compute; what it tells is whether a scene is built, each text compiles with the
options of a run, each launch of a fused kernel has as many arguments as the kernel, and which launches a graph makes
while decisions of kernels are those that a test gives in their place.
"""

import ctypes as c
import itertools
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from sim_server.backends.gpu import device, structs
from sim_server.backends.gpu import engine as gpu_engine
from sim_server.backends.gpu.conditions import Loop
from sim_server.backends.gpu.inverse import build_inverse
from sim_server.backends.gpu.inverse.workspace import workspace
from tests.backends.fake_cuda import FakeDevice
from tests.backends.fake_graphs import Graphs, Work
from tests.support import nvrtc

FUSED = r"\bfused\((int n[^)]*)\) \{"


class CompileException(Exception):
    """NVRTC refused a text."""


class Array(np.ndarray):
    """A device array."""

    @property
    def data(self) -> Any:  # type: ignore[override]
        return SimpleNamespace(ptr=self.ctypes.data)

    def get(self, stream: Any = None, out: np.ndarray | None = None) -> np.ndarray:
        if out is None:
            return np.array(self)
        assert out.shape == self.shape and out.dtype == self.dtype
        out[...] = self
        return out

    def set(self, values: np.ndarray) -> None:
        self[...] = values


class Graph:
    """A captured graph. The native loop launches all of them under one number, at which nothing is done."""

    graphExec = 7

    def __init__(self, run: Work):
        self._run = run

    def launch(self, stream: Any) -> None:
        self._run()


class Stream:
    """Does all at once."""

    ptr = 2
    graphs: Graphs

    def __init__(self, **options: Any):
        self.options = options

    def __enter__(self) -> None: ...
    def __exit__(self, *error: object) -> None: ...
    def synchronize(self) -> None: ...

    def begin_capture(self) -> None:
        self.graphs.begin()

    def end_capture(self) -> Graph:
        return Graph(self.graphs.end())

    def record(self) -> Any:
        return Event()

    def wait_event(self, event: Any) -> None: ...


class Event:
    """One that has come."""

    ptr = 6

    def __init__(self, **options: Any): ...
    def record(self, stream: Any = None) -> None: ...
    def synchronize(self) -> None: ...


def no_driver() -> structs.CudaDriver:
    """Functions that do nothing, in place of the driver's."""
    return structs.CudaDriver(**{name: c.cast(NOTHING, c.c_void_p) for name, _ in structs.CudaDriver._fields_})


NOTHING = c.CFUNCTYPE(c.c_int32)(lambda: 0)


class Device(FakeDevice):
    """The driver's functions for the native loop, as CudaDevice offers them."""

    has_conditions = True

    def __init__(self, cp: ModuleType):
        super().__init__()
        self.step_stream, self.copy_stream, self.graphs = Stream(), Stream(), {Graph.graphExec: lambda: None}

    def branch(self, flag: Array) -> AbstractContextManager[None]:
        return Stream.graphs.branch(flag)

    def repeat(self, flag: Array) -> AbstractContextManager[None]:
        return Stream.graphs.branch(flag, repeats=True)

    def loop(self) -> Loop:
        """The number by which kernels tell it is the address of its condition."""
        condition = np.zeros(1, np.int32)
        Stream.graphs.put(lambda: condition.fill(0))
        return Loop(condition.ctypes.data, lambda: Stream.graphs.branch(condition, repeats=True))

    def linked(self, text: str, name: str, options: Sequence[str]) -> Any:
        return sys.modules["cupy"].RawModule(code=text, options=[*options, "-rdc=true"])


def end_search(arguments: Any, loop: Any) -> None:
    """In place of `accept_trial` (newton.cu): no body needs another trial."""
    c.c_int32.from_address(int(arguments["active"])).value = 0
    if loop:
        go_on(loop, False)


def go_on(loop: Any, more: bool) -> None:
    """Tells a loop whether it goes on."""
    c.c_int32.from_address(int(loop)).value = more


@contextmanager
def installed(folder: Path, library: Any, monkeypatch: Any) -> Iterator[ModuleType]:
    """Context in which scenes for a GPU are built with the module that `made` returns."""
    fake, caches = made(folder, library), (device.cupy, device.processors, workspace)
    monkeypatch.setitem(sys.modules, "cupy", fake)
    monkeypatch.setattr(gpu_engine, "CudaDevice", Device)
    monkeypatch.setattr(build_inverse, "driver_functions", no_driver)
    for function in caches:
        function.cache_clear()
    yield fake
    for function in caches:
        function.cache_clear()


def made(folder: Path, library: Any) -> ModuleType:
    """The module. Texts are compiled in `folder`.

    calls: (kernel, number of arguments) of each launch
    ran: (kernel, text, grid, block, arguments) of each launch that was made, those of graphs when they ran
    kernels: by name, what stands for a kernel and gets its arguments; others do nothing. finish_step: of a step
    compiled: (text, options) of each module
    pending: arrays that were made since the host last waited for the current stream, and may not be there yet
    """
    cp: Any = ModuleType("cupy")
    cp.calls, cp.pending, cp.compiled, cp.ran = [], 0, set(), []
    kernels: dict[str, Callable[..., None]] = {"accept_trial": end_search}
    compiled, cp.kernels, Stream.graphs = cp.compiled, kernels, Graphs()
    numbers = itertools.count()  # of files: threads compile at the same time

    class CurrentStream(Stream):
        def synchronize(self) -> None:
            cp.pending = 0

    def array(values: np.ndarray) -> np.ndarray:
        cp.pending += 1
        return values.view(Array)

    class Function:
        def __init__(self, kernel: str, text: str, arguments: int | None):
            self.kernel, self.text, self.arguments, self.max_dynamic_shared_size_bytes = kernel, text, arguments, 0

        def __call__(self, grid: Any, block: Any, arguments: Any, shared_mem: int = 0) -> None:
            assert self.arguments in (len(arguments), None), self.kernel
            cp.calls.append((self.kernel, len(arguments)))
            given = tuple(np.array(x) for x in arguments)  # as they are now
            Stream.graphs.put(lambda: self.run(grid, block, given))

        def run(self, grid: Any, block: Any, arguments: Any) -> None:
            cp.ran.append((self.kernel, self.text, grid, block, arguments))
            name = "finish_step" if "finish_step" in self.text and self.kernel == "fused" else self.kernel
            if name in kernels:
                kernels[name](*arguments)

    class RawModule:
        def __init__(self, code: str, options: Any = (), backend: str = "", enable_cooperative_groups: bool = False):
            self.code, self.options = code, tuple(options)

        def get_function(self, kernel: str) -> Function:
            if (self.code, self.options) not in compiled:
                text = folder / f"text{next(numbers)}.cu"
                text.write_text(self.code)
                code, said = nvrtc.compiled(library, text, ["-arch=sm_90", "--Ofast-compile=max", *self.options])
                if not code:
                    raise CompileException(said)
                compiled.add((self.code, self.options))
            found = re.search(FUSED, self.code) if kernel == "fused" else None
            return Function(kernel, self.code, found[1].count(",") + 1 if found else None)

    class CurrentDevice:
        """The only one, whatever its number."""

        id, compute_capability, attributes = 0, "90", {"MultiProcessorCount": 132}

        def __init__(self, number: int = 0): ...
        def __enter__(self) -> None: ...
        def __exit__(self, *error: object) -> None: ...
        def use(self) -> None: ...

    memory = {
        name: lambda *a: None for name in ("memcpyAsync", "memsetAsync", "memcpyPeerAsync", "deviceEnablePeerAccess")
    }
    memory |= {"memGetInfo": lambda: (1, 1), "deviceCanAccessPeer": lambda a, b: 1}
    properties = {
        "name": b"Fake", "multiProcessorCount": 132, "sharedMemPerMultiprocessor": 233472,
        "sharedMemPerBlockOptin": 232448,
    }  # fmt: skip
    cp.RawModule, cp.asarray = RawModule, lambda x: array(np.array(x))
    cp.zeros = lambda shape, dtype=np.float64: array(np.zeros(shape, dtype))
    cp.empty = cp.zeros
    cp.ones = lambda shape, dtype=np.float64: array(np.ones(shape, dtype))
    cp.full = lambda shape, value, dtype: array(np.full(shape, value, dtype))
    cp.empty_like = lambda like: array(np.empty_like(like))
    cp.cuda = SimpleNamespace(
        runtime=SimpleNamespace(
            getDeviceCount=lambda: 1, CUDARuntimeError=type("CUDARuntimeError", (RuntimeError,), {}),
            getDeviceProperties=lambda number: properties, memcpyDeviceToDevice=3, memcpyHostToDevice=1,
            memcpyDeviceToHost=2, memcpyDefault=4,
            runtimeGetVersion=lambda: 13000, **memory,
        ),
        Device=CurrentDevice, Event=Event,
        Stream=Stream, get_current_stream=CurrentStream, memory=SimpleNamespace(OutOfMemoryError=MemoryError),
        alloc_pinned_memory=lambda size: np.zeros(max(size, 1), np.uint8),
        compiler=SimpleNamespace(CompileException=CompileException),
    )  # fmt: skip
    return cp
