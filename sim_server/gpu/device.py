# SPDX-License-Identifier: MIT
"""An NVIDIA GPU: its arrays, and the kernel texts compiled for it by NVRTC.

Host arrays keep their names: `twin` gives the device array that stands for one, made and filled at the first call. So
the code that lists the launches of a step is the same on both devices.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backend import HERE, INCLUDE, Argument, CompileError, arguments_of
from sim_server.errors import DeviceError

MAILED = 4096  # threads of a launch whose number of items may change


@cache
def cupy() -> Any:
    """The cupy package, imported when a GPU is asked for; raises DeviceError."""
    try:
        import cupy as cp
    except ImportError as error:
        raise DeviceError(f"no GPU: CuPy is not usable ({error}); pip install 'warpfactor[gpu]'") from error
    try:
        count = cp.cuda.runtime.getDeviceCount()
    except cp.cuda.runtime.CUDARuntimeError as error:
        raise DeviceError(_no_device(error)) from error
    if count == 0:
        raise DeviceError("no GPU: CuPy sees no NVIDIA device (is CUDA_VISIBLE_DEVICES empty?)")
    return cp


def _no_device(error: Exception) -> str:
    text = str(error)
    if "InsufficientDriver" in text:
        return (
            f"no GPU: there is no NVIDIA driver, or it is too old for this CuPy ({text}); nvidia-smi shows it. "
            "Update the driver, or install the CuPy of its CUDA version (for 12: pip install 'cupy-cuda12x[ctk]')"
        )
    if "NoDevice" in text:
        return f"no GPU: CuPy sees no NVIDIA device ({text}); see nvidia-smi and CUDA_VISIBLE_DEVICES"
    return f"no GPU: the NVIDIA driver does not answer ({text}); see nvidia-smi"


def no_memory_left(error: Exception) -> bool:
    """The GPU (or page-locked host memory) has no room for what was asked for."""
    cp = cupy()
    out = isinstance(error, cp.cuda.memory.OutOfMemoryError)
    return out or (isinstance(error, cp.cuda.runtime.CUDARuntimeError) and "MemoryAllocation" in str(error))


@contextmanager
def building() -> Iterator[None]:
    """While a scene is put onto the GPU: too little memory becomes a DeviceError that says what to do."""
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


def compiled(name: str, module: Any, kernel: str) -> Any:
    """A kernel of a text; raises CompileError with the first error of the compiler."""
    try:
        return module.get_function(kernel)
    except cupy().cuda.compiler.CompileException as error:
        lines = str(error).splitlines()
        first = next((line for line in lines if "error" in line), lines[0] if lines else "no message")
        raise CompileError(f"{name} does not compile for this GPU: {first.strip()}") from error


@cache
def _processors() -> int:
    return int(cupy().cuda.Device().attributes["MultiProcessorCount"])


@cache
def texts() -> str:
    """Of all headers, in an option: CuPy keeps compiled kernels by their own text and options alone."""
    found = sorted(p for p in HERE.rglob("*") if p.suffix in (".h", ".cuh"))
    return "-DTEXTS=x" + hashlib.sha256(b"".join(path.read_bytes() for path in found)).hexdigest()[:16]


def shape(threads: int) -> tuple[tuple[int], tuple[int]]:
    """Grid and thread blocks for so many threads: small blocks spread a small launch over more processors."""
    block = next((b for b in (32, 64) if threads <= 16 * b * _processors()), 128)
    return (max(1, -(-threads // block)),), (block,)


class DeviceLaunch:
    """One kernel with its arguments on the device. mailed: they lie in device memory and may be replaced."""

    def __init__(
        self, name: str, function: Any, params: NDArray[Any], items: int, mailed: bool, arrays: dict[str, Any]
    ):  # fmt: skip
        self.name, self.items, self.mailed, self._arrays = name, items, mailed, arrays
        self._function, self.params = function, params
        self.text = self.struct = ""  # where it comes from
        self.sums = False  # its items sum over lists
        self._mail = cupy().asarray(params.reshape(1).view(np.uint8)) if mailed else None

    def __call__(self) -> None:
        """Puts it onto the current stream."""
        argument = self._mail if self.mailed else self.params
        if self.items or self.mailed:
            self._function(*shape(MAILED if self.mailed else self.items), (argument,))

    def fetch(self, name: str) -> NDArray[Any]:
        """One of its arrays as kernels have left it, copied."""
        return self._arrays[name].get()

    @property
    def mail_address(self) -> int:
        """Where the arguments of a mailed launch lie."""
        assert self._mail is not None
        return int(self._mail.data.ptr)


class DeviceModule:
    """A kernel text compiled by NVRTC; raises CompileError."""

    def __init__(self, path: str, gpu: "Gpu", real: str = "double", cooperative: bool = False):
        source = HERE / path
        self.name, self.real, self._gpu, self._text = source.stem, real, gpu, source.read_text()
        self._module = cupy().RawModule(
            code=self._text,
            options=("-std=c++17", f"-I{INCLUDE}", f"-Dreal={real}", texts()),
            backend="nvrtc",
            enable_cooperative_groups=cooperative,
        )

    def function(self, kernel: str) -> Any:
        """A kernel by name."""
        return compiled(f"{self.name}.cu", self._module, kernel)

    def bind(self, kernel: str, n: int, **arguments: Any) -> DeviceLaunch:
        """As backend.Module.bind, with the twins of the arrays."""
        fields, struct, form = arguments_of(self._text, kernel, self.name, self.real, {"n": n, **arguments})
        mailed = form == "MAILED_"
        params = np.zeros((), dtype=_layout(fields))
        twins = {}
        for field, value in fields:
            if field.dtype is not None:
                twins[field.name] = self._gpu.twin(value, keep=not mailed)
                value = twins[field.name].data.ptr
            params[field.name] = value
        launch = DeviceLaunch(f"{self.name}.{kernel}", self.function(kernel), params, n, mailed, twins)
        launch.text, launch.struct, launch.sums = self._text, struct, form == "SUM_"
        return launch


def _layout(fields: list[tuple[Argument, Any]]) -> np.dtype:
    types = {"int": "i4", "double": "f8", "float": "f4"}
    return np.dtype([(f.name, "u8" if f.dtype is not None else types[f.kind]) for f, _ in fields], align=True)


class Gpu:
    """The current CUDA device."""

    name = "gpu"

    def __init__(self) -> None:
        self.cp = cupy()
        self._twins: dict[int, tuple[NDArray[Any], Any]] = {}
        self._modules: dict[str, DeviceModule] = {}
        self.properties = self.cp.cuda.runtime.getDeviceProperties(self.cp.cuda.Device().id)

    def twin(self, host: NDArray[Any], keep: bool = True) -> Any:
        """The device array of a host array. keep: the same one from now on; else of a new one just a copy."""
        known = self._twins.get(id(host))
        if known is not None:
            return known[1]
        copy = self.cp.asarray(host)
        if keep:
            self._twins[id(host)] = (host, copy)  # keeping the host array keeps its id its own
        return copy

    def keep(self, *hosts: NDArray[Any]) -> None:
        """Arrays that stay for the whole run have one twin each from now on."""
        for host in hosts:
            self.twin(host)

    def fetch(self, host: NDArray[Any]) -> NDArray[Any]:
        """The array with what kernels have made of its twin."""
        if id(host) in self._twins:
            host[...] = self.twin(host).get()
        return host

    def module(self, path: str) -> DeviceModule:
        """A kernel text, compiled once."""
        if path not in self._modules:
            self._modules[path] = DeviceModule(path, self)
        return self._modules[path]
