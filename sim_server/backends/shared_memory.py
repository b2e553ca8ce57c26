# SPDX-License-Identifier: MIT
"""The interface of device memory that other processes can open; on a GPU gpu/shared_device_memory.py."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64


class Allocation(NamedTuple):
    """Device memory that other processes can open. handle: by which they do"""

    handle: bytes
    address: int


class PlacedMatrix(NamedTuple):
    """A matrix, on the host. on_device: address of the same on the device; 0: it is not there"""

    values: Float64
    on_device: int


class SharedMemory(Protocol):
    """Device memory of this process that others can open. Methods may be called from any thread, and wait.

    limit: bytes that may be allocated
    sums: checksums of factors will be asked for, as by a log
    """

    limit: int
    sums: bool

    def allocate(self, size: int) -> Allocation | None:
        """Allocates memory for good; None if there is not enough, or no other process can open it."""
        ...

    def read(self, address: int, count: int) -> NDArray[np.uint64]:
        """Copies numbers to the host."""
        ...

    def write(self, address: int, values: NDArray[np.uint64]) -> None:
        """Copies numbers from the host."""
        ...

    def put(self, address: int, matrices: Sequence[PlacedMatrix]) -> None:
        """Copies matrices one after another; they are there when this returns."""
        ...

    def take(self, address: int, pattern: FactorPattern, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Returns a copy of the values of a factor in memory that no other process can write to: an array of the host,
        or what stands for one. Raises Refused unless they are finite and their diagonal is positive."""
        ...
