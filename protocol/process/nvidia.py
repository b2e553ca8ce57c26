# SPDX-License-Identifier: MIT
"""Whether there is an NVIDIA device, according to the driver, so that machines without one get no messages on GPUs."""

import ctypes

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
