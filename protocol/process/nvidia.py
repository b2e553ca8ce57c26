# SPDX-License-Identifier: MIT
"""Finds an NVIDIA device: by the driver, so that machines without one get no messages on GPUs, and by CuPy."""

import ctypes
from typing import Any

from protocol.process.extras import to_install

NONE = (34, 100)  # CUDA_ERROR_STUB_LIBRARY, CUDA_ERROR_NO_DEVICE


def nvidia_device() -> bool:
    """True if the driver has a device for this process, or fails in a way that the user should know."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    if error := driver.cuInit(0):
        return error not in NONE
    count = ctypes.c_int(0)
    return bool(driver.cuDeviceGetCount(ctypes.byref(count)) or count.value)


class NoGpu(Exception):
    """CuPy cannot use a GPU; the text says why in one line."""


def usable_cupy() -> Any:
    """Imports CuPy and checks that it sees a device. Raises NoGpu."""
    try:
        import cupy as cp
    except ImportError as error:
        raise NoGpu(f"CuPy is not usable ({first_line(error)}); {to_install('gpu')}") from error
    try:
        count = cp.cuda.runtime.getDeviceCount()
    except cp.cuda.runtime.CUDARuntimeError as error:
        raise NoGpu(_no_device(first_line(error))) from error
    if count == 0:
        raise NoGpu("CuPy sees no NVIDIA device (is CUDA_VISIBLE_DEVICES empty?)")
    return cp


def first_line(error: Exception) -> str:
    """Returns the first line of an error's text, or its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _no_device(text: str) -> str:
    if "InsufficientDriver" in text:
        return (
            f"there is no NVIDIA driver, or it is too old for this CuPy ({text}); nvidia-smi shows it. "
            "Update the driver, or install the CuPy of its CUDA version (for 12: pip install 'cupy-cuda12x[ctk]')"
        )
    if "NoDevice" in text:
        return f"CuPy sees no NVIDIA device ({text}); see nvidia-smi and CUDA_VISIBLE_DEVICES"
    return f"the NVIDIA driver does not answer ({text}); see nvidia-smi"
