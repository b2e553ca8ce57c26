# SPDX-License-Identifier: MIT
"""Arrays in page-locked host memory, which the device reads by itself, beside other work."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.shared_memory.located import Located
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.structs import BUILD

WHERE = BUILD.enumeration("ValuesAre")  # values of a build may be


class PinnedArray(Located):
    """An array in page-locked memory. Its memory is used again once nothing refers to it."""


def room_for(size: int) -> int:
    """Returns bytes that an array of this size takes, up to an eighth more: the pool of CuPy uses memory again for
    exactly as many, and gives none of it back. Factors of a body that is cut are all of nearly one size."""
    step = 1 << max(size.bit_length() - 4, 9)
    return max(-(-size // step), 1) * step


def pinned_array(cp: Any, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Makes an array (count,) with any contents, in memory of CuPy's pool, whose pages have been touched before; one
    that is not page-locked where the host has no such memory left."""
    try:
        memory = cp.cuda.alloc_pinned_memory(room_for(count * dtype.itemsize))
    except cp.cuda.runtime.CUDARuntimeError:
        return np.empty(count, dtype)
    array: NDArray[Any] = np.frombuffer(memory, dtype, count).view(PinnedArray)
    return array


def is_pinned(array: NDArray[Any] | DeviceValues) -> bool:
    """True if the device can read an array, all of it together, by itself: it may be there already."""
    return isinstance(array, DeviceValues) or (isinstance(array, PinnedArray) and array.flags.c_contiguous)


def readable(
    arrays: Sequence[NDArray[Any] | DeviceValues], dtype: np.dtype[Any]
) -> tuple[Sequence[NDArray[Any] | DeviceValues], int]:
    """Returns arrays of a type as they are if the device can read all of them by itself, else in usual memory; and
    where they are (ValuesAre of launch_build.h)."""
    if all(each.dtype == dtype and is_pinned(each) for each in arrays):
        on_device = sum(isinstance(each, DeviceValues) for each in arrays)
        if on_device in (0, len(arrays)):
            return arrays, WHERE["ON_DEVICE"] if on_device else WHERE["PAGE_LOCKED"]
    return [np.ascontiguousarray(np.asarray(each), dtype) for each in arrays], WHERE["PAGEABLE"]
