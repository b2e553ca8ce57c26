# SPDX-License-Identifier: MIT
"""Is there an NVIDIA device? Asked of the driver itself, so that nobody reads of GPUs on a machine without one."""

import ctypes

NONE = (34, 100)  # CUDA_ERROR_STUB_LIBRARY, CUDA_ERROR_NO_DEVICE


def nvidia_device() -> bool:
    """Whether the driver has a device for this process; also if it fails in a way that its owner should hear of."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    if error := driver.cuInit(0):
        return error not in NONE
    count = ctypes.c_int(0)
    return bool(driver.cuDeviceGetCount(ctypes.byref(count)) or count.value)
