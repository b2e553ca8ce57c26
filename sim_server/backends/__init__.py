# SPDX-License-Identifier: MIT
"""Where steps run: on the processor's cores or on a GPU. The contract of both is in base.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
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


def bytes_of_copies(device: str, precision: str) -> Callable[[Sequence[float]], float] | None:
    """Returns what tells the bytes of the host that the loop keeps for copies of matrices, from the 3x3 blocks of each;
    None: it keeps none."""
    if device != "gpu":
        return None
    from sim_server.backends.gpu.loop import bytes_of_copies as told

    return partial(told, real="float32" if precision == "float32" else "float64")
