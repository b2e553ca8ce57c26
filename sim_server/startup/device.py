# SPDX-License-Identifier: MIT
"""Chooses the device that a server runs on."""

from collections.abc import Callable

from protocol.process.nvidia import nvidia_device
from sim_server.errors import DeviceError


def choose_device(device: str, say: Callable[[str], None]) -> str:
    """Returns the device to run on; auto: the GPU if there is a usable one. Reports why a GPU is not usable."""
    if device != "auto":
        return device
    if not nvidia_device():
        return "cpu"
    from sim_server.backends.gpu.device import cupy

    try:
        cupy()
    except DeviceError as error:
        say(f"on the CPU; {error}")
        return "cpu"
    return "gpu"
