# SPDX-License-Identifier: MIT
"""Where steps run: on the processor's cores or on a GPU. The contract of both is in base.py."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim_server.backends.base import Backend


def create(device: str, precision: str) -> Backend:
    """Returns the backend of a device, "cpu" or "gpu", with kernels of this precision. Raises DeviceError."""
    if device == "gpu":
        from sim_server.backends.gpu.device import Gpu

        return Gpu(precision)
    from sim_server.backends.cpu.device import Cpu

    return Cpu()
