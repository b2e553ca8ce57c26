# SPDX-License-Identifier: MIT
"""Arrays that know their address, for what hands many of them to native code: NumPy takes 2 us to tell each."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Located(np.ndarray):
    """An array with the address of its first number; 0: not noted. Views of it have none, they begin elsewhere."""

    address: int = 0


def address(array: NDArray[Any]) -> int:
    """Returns the address of the first number of an array.

    With fields the interface is described by code in Python, and NumPy drops what a signal raises in there.
    """
    known: int = getattr(array, "address", 0)
    return known or int(array.ctypes.data if array.dtype.names else array.__array_interface__["data"][0])


def addresses(arrays: Sequence[Any]) -> NDArray[np.uintp]:
    """Returns the address of each array, or of what else knows its own."""
    return np.array([getattr(each, "address", 0) or address(each) for each in arrays], np.uintp)


def rows(memory: NDArray[Any], counts: list[int]) -> list[NDArray[Any]]:
    """Cuts memory (n,), contiguous, into arrays of so many numbers, one behind the other."""
    own, at, begin = memory if isinstance(memory, Located) else memory.view(Located), 0, address(memory)
    found: list[NDArray[Any]] = []
    for count in counts:
        row: Any = own[at : at + count]
        row.address = begin + at * memory.itemsize
        found.append(row)
        at += count
    return found
