# SPDX-License-Identifier: MIT
"""The NVIDIA GPU of a worker: found, and its kernels compiled, or said in one line why not."""

from functools import cache
from pathlib import Path
from typing import Any

from precond_worker.errors import DeviceUnusable
from protocol.extras import to_install

SOURCE = Path(__file__).with_name("multifrontal.cu")
ARITHMETIC = ("auto", "float32", "float64")
KERNELS = ("reset", "look", "assemble", "factor", "panel", "update", "store")
_C_TYPES = {"float32": "float", "float64": "double"}


@cache
def cupy() -> Any:
    """The cupy package with a device behind it; raises DeviceUnusable."""
    try:
        import cupy as cp
    except ImportError as error:
        raise DeviceUnusable(f"needs CuPy ({_first_line(error)}); {to_install('gpu')}") from error
    try:
        count = cp.cuda.runtime.getDeviceCount()
    except cp.cuda.runtime.CUDARuntimeError as error:
        text = f"no usable NVIDIA driver, or one that is older than CuPy's CUDA; see nvidia-smi ({error})"
        raise DeviceUnusable(text) from error
    if count == 0:
        raise DeviceUnusable("no NVIDIA GPU is visible (CUDA_VISIBLE_DEVICES?)")
    return cp


def name() -> str:
    """Of the device, such as "NVIDIA H200"; raises DeviceUnusable."""
    cp = cupy()
    return str(cp.cuda.runtime.getDeviceProperties(cp.cuda.Device().id)["name"].decode())


@cache
def best_arithmetic() -> str:
    """float64 where it costs a GPU at most twice the time of float32, as on those for data centres."""
    cp = cupy()
    return "float64" if cp.cuda.Device().attributes["SingleToDoublePrecisionPerfRatio"] <= 2 else "float32"


@cache
def kernels(arithmetic: str, stored: str) -> dict[str, Any]:
    """The kernels by name; stored: type of the values of L. Compiled by NVRTC at the first call, kept on disk by CuPy.

    Raises DeviceUnusable with what the compiler says.
    """
    cp = cupy()
    options = ("-std=c++17", f"-Dreal={_C_TYPES[arithmetic]}", f"-DValue={_C_TYPES[stored]}")
    try:
        module = cp.RawModule(code=SOURCE.read_text(), options=options, backend="nvrtc")
        return {kernel: module.get_function(kernel) for kernel in KERNELS}
    except Exception as error:  # of CuPy's compiler, of the driver, or of a library that is not there
        raise DeviceUnusable(f"{SOURCE.name} does not compile for this GPU: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def try_out(arithmetic: str = "auto") -> str:
    """Name of the device if it can do what it is for; raises DeviceUnusable."""
    if arithmetic not in ARITHMETIC:
        raise ValueError(f"GPU arithmetic {arithmetic!r}, allowed: {', '.join(ARITHMETIC)}")
    kernels(best_arithmetic() if arithmetic == "auto" else arithmetic, "float32")
    return name()
