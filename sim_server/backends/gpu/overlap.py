# SPDX-License-Identifier: MIT
"""Launches with programmatic stream serialization: a kernel may come to the device before the one before it ends.

Only for kernels that wait for it themselves (overlap.cuh). CuPy has no interface to it, so the driver is called.
Source: CUDA driver API, cuLaunchKernelEx (CUDA 12.0 and above; it has an effect on compute capability 9.0 and above).
"""

import ctypes as c
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_server.errors import DeviceError

PROGRAMMATIC_STREAM_SERIALIZATION = 6  # CUlaunchAttributeID


class LaunchAttribute(c.Structure):
    """CUlaunchAttribute, with the value as an int."""

    _fields_ = [("id", c.c_int), ("padding", c.c_int), ("value", c.c_int), ("rest", c.c_char * 60)]


class LaunchConfig(c.Structure):
    """CUlaunchConfig."""

    _fields_ = [
        ("grid", c.c_uint * 3), ("block", c.c_uint * 3), ("shared_bytes", c.c_uint), ("stream", c.c_void_p),
        ("attributes", c.POINTER(LaunchAttribute)), ("attribute_count", c.c_uint),
    ]  # fmt: skip


def launch_overlapping(
    driver: c.CDLL, function: Any, grid: int, block: int, arguments: Sequence[Any], shared: int, stream: int
) -> None:
    """Appends a launch to a stream. function: cupy.RawKernel. arguments: NumPy scalars and structs (0-d arrays).

    Raises DeviceError.
    """
    memory = [np.array(argument) for argument in arguments]
    pointers = (c.c_void_p * max(len(memory), 1))(*(array.ctypes.data for array in memory))
    attribute = LaunchAttribute(id=PROGRAMMATIC_STREAM_SERIALIZATION, value=1)
    config = LaunchConfig((grid, 1, 1), (block, 1, 1), shared, stream, c.pointer(attribute), 1)
    handle = c.c_void_p(int(function.kernel.ptr))
    if error := driver.cuLaunchKernelEx(c.byref(config), handle, pointers, None):
        raise DeviceError(f"the NVIDIA driver refused cuLaunchKernelEx: CUDA error {error}")
