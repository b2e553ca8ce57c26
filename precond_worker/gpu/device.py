# SPDX-License-Identifier: MIT
"""The NVIDIA GPU of a worker and its kernels; errors say in one line why it cannot be used."""

from functools import cache
from pathlib import Path
from typing import Any

from precond_worker.errors import DeviceUnusable
from protocol.process.nvidia import NoGpu, first_line, usable_cupy

SOURCE = Path(__file__).with_name("multifrontal.cu")
PRECISIONS = ("auto", "float32", "float64")
KERNELS = ("reset", "check_finite", "assemble", "factor", "panel", "update", "store", "check_pivots")
_C_TYPES = {"float32": "float", "float64": "double"}


@cache
def cupy() -> Any:
    """Imports CuPy and checks that it sees a device. Raises DeviceUnusable."""
    try:
        return usable_cupy()
    except NoGpu as error:
        raise DeviceUnusable(str(error)) from error


def name() -> str:
    """Returns the name of the device, e.g. "NVIDIA H200"; raises DeviceUnusable."""
    cp = cupy()
    return str(cp.cuda.runtime.getDeviceProperties(cp.cuda.Device().id)["name"].decode())


@cache
def best_precision() -> str:
    """Returns float64 if it takes the GPU at most twice the time of float32, as on those for data centres."""
    cp = cupy()
    return "float64" if cp.cuda.Device().attributes["SingleToDoublePrecisionPerfRatio"] <= 2 else "float32"


@cache
def kernels(precision: str, stored: str) -> dict[str, Any]:
    """Compiles the kernels by NVRTC and returns them by name; CuPy caches them. stored: type of the values of L.

    Raises DeviceUnusable with what the compiler says.
    """
    cp = cupy()
    options = ("-std=c++17", f"-Dreal={_C_TYPES[precision]}", f"-DValue={_C_TYPES[stored]}")
    try:
        module = cp.RawModule(code=SOURCE.read_text(), options=options, backend="nvrtc")
        return {kernel: module.get_function(kernel) for kernel in KERNELS}
    except Exception as error:  # of CuPy's compiler, of the driver, or of a library that is not there
        raise DeviceUnusable(f"{SOURCE.name} does not compile for this GPU: {first_line(error)}") from error


def try_out(precision: str = "auto") -> str:
    """Compiles the kernels and returns the name of the device; raises DeviceUnusable."""
    if precision not in PRECISIONS:
        raise ValueError(f"GPU precision {precision!r}, allowed: {', '.join(PRECISIONS)}")
    kernels(best_precision() if precision == "auto" else precision, "float32")
    return name()
