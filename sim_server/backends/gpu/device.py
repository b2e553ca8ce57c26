# SPDX-License-Identifier: MIT
"""An NVIDIA GPU: its arrays, and the kernel texts that NVRTC compiles for it.

Code that lists the launches of a step is the same on both devices, since it names host arrays: `Gpu.twin` returns the
device array of a host array, which it makes and fills at the first call.
"""

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.process.nvidia import NoGpu, usable_cupy
from sim_server.backends.base import Engine, EngineInput
from sim_server.backends.build_pool import CompileError, compilers
from sim_server.backends.compiler import INCLUDE, SOURCES, ahead, build_id, names
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction, KernelModule
from sim_server.backends.kernel_binding import BoundKernel, KernelText, structure_of
from sim_server.errors import DeviceError

CAPABILITY = 80  # compute capability times 10; the solver needs matrix instructions of float16
# Texts that are loaded with the first factor, or before it where its pattern is known: all runs count them as used
LATER = ("backends/gpu/inverse/digits.cpp", "backends/gpu/inverse/tree_cuts.cpp")
MAILED_THREADS = 4096  # of a launch whose number of items may change


@cache
def cupy() -> Any:
    """Imports CuPy and checks the device. Raises DeviceError."""
    try:
        cp = usable_cupy()
    except NoGpu as error:
        raise DeviceError(f"no GPU: {error}") from error
    if int(capability := cp.cuda.Device().compute_capability) < CAPABILITY:
        raise DeviceError(
            f"no GPU: this one has compute capability {int(capability) / 10:g}, allowed: {CAPABILITY / 10:g} and above"
        )
    return cp


def no_memory_left(error: Exception) -> bool:
    """True if the error is a lack of device memory or page-locked host memory."""
    cp = cupy()
    out = isinstance(error, cp.cuda.memory.OutOfMemoryError)
    return out or (isinstance(error, cp.cuda.runtime.CUDARuntimeError) and "MemoryAllocation" in str(error))


@contextmanager
def building() -> Iterator[None]:
    """Translates lack of memory while a scene is built into a DeviceError that says what to do."""
    try:
        yield
    except Exception as error:
        if not no_memory_left(error):
            raise
        free, total = cupy().cuda.runtime.memGetInfo()
        raise DeviceError(
            f"the scene does not fit into the memory of the GPU: {error}; {free / 1e9:.2f} of {total / 1e9:.2f} GB are "
            "free. Fewer or smaller objects need less, or --device cpu"
        ) from error


def compiled(name: str, module: KernelModule, kernel: str) -> KernelFunction:
    """Returns a kernel of a text. Raises CompileError with the first error of the compiler."""
    try:
        with compilers.counted():
            return module.get_function(kernel)
    except cupy().cuda.compiler.CompileException as error:
        lines = str(error).splitlines()
        first = next((line for line in lines if "error" in line), lines[0] if lines else "no message")
        raise CompileError(f"{name} does not compile for this GPU: {first.strip()}") from error


@cache
def processors() -> int:
    """Returns the number of multiprocessors of the device."""
    return int(cupy().cuda.Device().attributes["MultiProcessorCount"])


@cache
def digest(*suffixes: str) -> str:
    """Returns a digest of all texts of this package with these suffixes."""
    found = sorted(p for p in SOURCES.rglob("*") if p.suffix in suffixes)
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).hexdigest()[:16]


def headers_option() -> str:
    """Returns a compiler option with the digest of all headers, since CuPy caches kernels by text and options alone."""
    return "-DTEXTS=x" + digest(".h", ".cuh")


def grid_of(threads: int) -> tuple[tuple[int], tuple[int]]:
    """Returns grid and block of a launch; small thread blocks spread a small launch over more multiprocessors."""
    block = next((b for b in (32, 64) if threads <= 16 * b * processors()), 128)
    return (max(1, -(-threads // block)),), (block,)


class DeviceModule(KernelText):
    """A kernel text that NVRTC compiles. Raises CompileError."""

    def __init__(self, path: str, gpu: "Gpu", real: str = "double", cooperative: bool = False, local: str = ""):
        super().__init__(path, {"real": real, "local": local or real})
        self.gpu = gpu
        self._module = cupy().RawModule(
            code=self.text,
            options=(*options(self.types), *folder_options(self.folder)),
            backend="nvrtc",
            enable_cooperative_groups=cooperative,
        )

    def function(self, kernel: str) -> KernelFunction:
        """Returns a kernel by name. Raises CompileError."""
        return compiled(f"{self.name}.cu", self._module, kernel)

    def bind(self, kernel: str, n: int, **arguments: Any) -> "DeviceLaunch":
        """Returns the launch of `kernel` over n items, with the twins of the arrays."""
        return DeviceLaunch(self, kernel, {"n": n, **arguments})


class DeviceLaunch(BoundKernel):
    """A kernel with its arguments on the device.

    arrays: twins of the arrays, by argument. The arguments of a mailed launch are in device memory and may be replaced.
    module: its text
    """

    def __init__(self, module: DeviceModule, kernel: str, given: dict[str, Any]):
        super().__init__(module, kernel, given, converts=True)
        self.module = module
        self.params = np.zeros((), dtype=structure_of(self.fields))
        self.arrays: dict[str, DeviceArray] = {}
        for f, value in zip(self.fields, self.values, strict=True):
            if f.dtype is not None:
                self.arrays[f.name] = module.gpu.twin(value, keep=not self.mailed, dtype=f.dtype)
            self.params[f.name] = value if f.dtype is None else self.arrays[f.name].data.ptr
        self._function = module.function(kernel)
        self._mail = cupy().asarray(self.params.reshape(1).view(np.uint8)) if self.mailed else None

    def __call__(self) -> None:
        """Appends the launch to the current stream."""
        argument = self._mail if self.mailed else self.params
        if self.items or self.mailed:
            self._function(*grid_of(MAILED_THREADS if self.mailed else self.items), (argument,))

    def with_array(self, array: DeviceArray, other: DeviceArray) -> "DeviceLaunch":
        """Returns the same launch with `other` in place of `array`; itself if it does not use it."""
        names = [name for name, mine in self.arrays.items() if mine is array]
        if not names:
            return self
        assert not self.mailed
        made = copy(self)
        made.arrays, made.params = {**self.arrays, **dict.fromkeys(names, other)}, self.params.copy()
        for name in names:
            made.params[name] = other.data.ptr
        return made

    def fetch(self, name: str) -> NDArray[Any]:
        """Copies one of its arrays to the host."""
        array: NDArray[Any] = self.arrays[name].get()
        return array

    @property
    def mail_address(self) -> int:
        """Device address of the arguments of a mailed launch."""
        assert self._mail is not None
        return int(self._mail.data.ptr)


def own_headers() -> tuple[str, ...]:
    """Returns the compiler options for headers of this folder."""
    return f"-I{SOURCES / 'backends/gpu'}", f"-I{SOURCES / 'backends/gpu/inverse'}"


def options(types: dict[str, str]) -> tuple[str, ...]:
    """Returns the compiler options of a text. types: that `real` and `local` stand for."""
    return ("-std=c++17", f"-I{INCLUDE}", *(f"-D{name}={kind}" for name, kind in types.items()), headers_option())


def folder_options(*folders: Path | None) -> tuple[str, ...]:
    """Returns the compiler options for texts of other packages. folders: of texts, None for those of this package."""
    found = sorted({folder for folder in folders if folder is not None})
    headers = sorted(p for folder in found for p in folder.iterdir() if p.suffix in (".h", ".cuh"))
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in headers)).hexdigest()[:16]
    return (*(f"-I{folder}" for folder in found), *((f"-DTEXTS_OUTSIDE=x{digest}",) if headers else ()))


PRECISIONS = {
    "float64": {"real": "double", "local": "double"},
    "mixed": {"real": "double", "local": "float"},
    "float32": {"real": "float", "local": "float"},
}
"""Types `real` (state and system) and `local` (elements) of kernel texts, by precision (kernels/kernel.h)."""


class Gpu:
    """The current CUDA device. precision: of the kernels, a key of PRECISIONS; host arrays are always float64."""

    name = "gpu"
    building = staticmethod(building)

    def __init__(self, precision: str = "float64") -> None:
        ahead("backends/gpu/loop.cpp")  # takes longest to compile
        self.cp = cupy()
        self.precision, self.types = precision, PRECISIONS[precision]
        self._real = np.dtype("f4" if self.types["real"] == "float" else "f8")
        self._twins: dict[int, tuple[NDArray[Any], DeviceArray]] = {}
        self._kept: dict[int, tuple[NDArray[Any], np.dtype | None]] = {}  # keeping an array keeps its id its own
        self._modules: dict[str, DeviceModule] = {}
        self._device, self._fetching = self.cp.cuda.Device(), ThreadPoolExecutor(1, "copies")
        self.properties = self.cp.cuda.runtime.getDeviceProperties(self.cp.cuda.Device().id)

    def twin(self, host: NDArray[Any], keep: bool = True, dtype: np.dtype | None = None) -> DeviceArray:
        """Returns the device array of a host array, which is filled when it is made.

        keep: the same array from now on; False: a new copy, unless the host array has a twin or was declared by `keep`
        dtype: of its entries; None: its declared type, else `real` for float64
        """
        if id(host) in self._twins:
            known = self._twins[id(host)][1]
            if dtype not in (None, known.dtype):
                raise TypeError(f"an array of {host.shape} is {known.dtype} on the GPU and cannot be {dtype} too")
            return known
        kept = self._kept.get(id(host))
        dtype = dtype or (kept and kept[1]) or (self._real if host.dtype == np.float64 else host.dtype)
        made: DeviceArray = self.cp.asarray(host.astype(dtype, copy=False))
        if keep or kept:
            self._twins[id(host)] = (host, made)
        return made

    def known_twin(self, host: NDArray[Any]) -> DeviceArray | None:
        """Returns the device array of a host array, if it has one."""
        return self._twins[id(host)][1] if id(host) in self._twins else None

    def keep(self, *hosts: NDArray[Any], exact: bool = False) -> None:
        """Declares arrays that stay for the whole run, with one twin each. exact: the twins have the same types."""
        for host in hosts:
            self._kept.setdefault(id(host), (host, host.dtype if exact else None))

    def fetch(self, host: NDArray[Any]) -> NDArray[Any]:
        """Copies the twin into the host array, and returns it."""
        if id(host) in self._twins:
            host[...] = self.twin(host).get()
        return host

    def begin_fetch(self, host: NDArray[Any]) -> Future[NDArray[Any]]:
        """Begins to copy the twin of an array in a thread; the array of the host does not change."""

        def copied() -> NDArray[Any]:
            self._device.use()  # the current device is one of each thread
            found: NDArray[Any] = self._twins[id(host)][1].get() if id(host) in self._twins else host
            return found.astype(host.dtype, copy=False)

        return self._fetching.submit(copied)

    def push(self, host: NDArray[Any]) -> None:
        """Copies the host array into its twin."""
        if id(host) in self._twins:
            twin = self.twin(host)
            twin.set(host.astype(twin.dtype, copy=False))

    def view(self, host: NDArray[Any]) -> DeviceArray:
        """Returns the twin."""
        return self.twin(host)

    def settle(self) -> None:
        """Waits for all streams of the device."""
        self.cp.cuda.runtime.deviceSynchronize()

    def engine(self, given: EngineInput) -> Engine:
        """Returns the loop over launches of this backend."""
        from sim_server.backends.gpu.engine import GpuEngine

        return GpuEngine(self, given)

    def build(self) -> str:
        """Returns a digest of code, device and CUDA; runs of a scene with equal ones agree bit for bit."""
        runtime = self.cp.cuda.runtime.runtimeGetVersion()
        parts = [
            build_id(),
            *names(*LATER),
            digest(".cu", ".cuh", ".h"),
            self.properties["name"].decode(),
            str(runtime),
        ]
        outside = [module for module in self._modules.values() if module.folder is not None]
        parts += sorted(module.text + " ".join(folder_options(module.folder)[1:]) for module in outside)
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]

    def module(self, path: str) -> DeviceModule:
        """Returns the module of a kernel text, compiled once."""
        if path not in self._modules:
            self._modules[path] = DeviceModule(path, self, self.types["real"], local=self.types["local"])
        return self._modules[path]
