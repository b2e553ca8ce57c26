# SPDX-License-Identifier: MIT
"""What the engine of a GPU carries on from step to step, in arrays of its own."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.state import StateArray


def device_array(
    name: str, array: DeviceArray, rows: Callable[[int], Any] | None = None, resets: bool = False, bodies: int = 0
) -> StateArray:  # fmt: skip
    """Returns an array of the device; none of the structs in it holds a pointer. bodies: it has as many rows."""
    shape = (bodies, -1) if bodies else array.shape

    def read() -> NDArray[Any]:
        return array.get().reshape(shape)

    def write(values: NDArray[Any]) -> None:
        array.set(np.ascontiguousarray(values).reshape(array.shape))

    return StateArray(name, read, write, rows, resets)


def device_arrays(prefix: str, memory: Mapping[str, DeviceArray], *names: str) -> list[StateArray]:
    """Returns those of the named arrays that there are."""
    return [device_array(f"{prefix}.{name}", memory[name]) for name in names if name in memory]
