# SPDX-License-Identifier: MIT
"""Values of a factor in device memory of this process, which nobody writes to any more."""

from concurrent.futures import Future
from typing import Any

from numpy.typing import NDArray

from protocol.validate import checksum
from sim_server.backends.gpu.cupy_types import DeviceArray


class DeviceValues:
    """In place of an array of the host, of which it has what the service asks for; NumPy copies it where it needs more.

    array: (n,) float32 or float64, complete
    sum: as of `checksum`, if it is reckoned beside the caller
    """

    def __init__(self, array: DeviceArray):
        self.array = array
        self.sum: Future[int] | None = None
        self.dtype, self.nbytes, self.size, self.shape = array.dtype, array.nbytes, array.size, array.shape

    def __len__(self) -> int:
        return self.size

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        found = self.array.get()
        return found if dtype is None else found.astype(dtype, copy=False)

    @property
    def address(self) -> int:
        """Of the first value."""
        return int(self.array.data.ptr)

    def copy(self) -> "DeviceValues":
        """Returns itself: it does not change."""
        return self

    def checksum(self) -> int:
        """Returns that of an array of the host with these values (validate.checksum)."""
        return checksum(self.array.get()) if self.sum is None else self.sum.result()
