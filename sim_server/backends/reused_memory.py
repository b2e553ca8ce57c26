# SPDX-License-Identifier: MIT
"""Memory of arrays that come again and again, used anew once nothing refers to them: its pages are there already."""

import math
import weakref
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

SMALL = 1 << 16  # bytes of arrays that the heap has room for
MOST = 4  # arrays at a time


class ReusedMemory:
    """Makes arrays with any contents. Of one thread at a time; arrays may be given up in any."""

    def __init__(self) -> None:
        self._lent: list[tuple[weakref.ref[NDArray[Any]], NDArray[np.uint8]]] = []  # owners of arrays, their memory

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Returns an array like np.empty. It and its views are nobody else's as long as one of them is there."""
        dtype = np.dtype(dtype)
        size = math.prod(shape) * dtype.itemsize
        if size < SMALL:
            return np.empty(shape, dtype)
        lent = [each for each in self._lent if each[0]() is not None]
        memory = next((m for owner, m in self._lent if owner() is None and m.size >= size), None)
        if memory is None and len(lent) >= MOST:
            return np.empty(shape, dtype)
        if memory is None:  # what is free is too small, and given back
            memory, self._lent = np.empty(1 << (size - 1).bit_length(), np.uint8), lent
        owner: NDArray[Any] = np.frombuffer(memory.data, dtype, math.prod(shape))
        self._lent = [*(each for each in self._lent if each[1] is not memory), (weakref.ref(owner), memory)]
        return owner.reshape(shape)
