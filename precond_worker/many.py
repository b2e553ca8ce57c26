# SPDX-License-Identifier: MIT
"""Several matrices of one pattern that are factorized together, and their factors."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from precond_worker.arrays import Float64


class Matrices(Protocol):
    """Matrices of one block pattern, each float64 (blocks, 3, 3). They may be checked only when they are asked for:
    both ways to get them raise protocol.refused.Refused."""

    blocks: int

    def __len__(self) -> int: ...

    def addresses(self) -> NDArray[np.uintp]:
        """Returns where each of them lies, (k,), as long as this object lives."""
        ...

    def copy_to(self, target: Float64) -> None:
        """Copies all to rows of `target`, (k, 9 blocks)."""
        ...


class GivenMatrices:
    """Matrices in memory of this process. blocks: of the first; 0 if they differ, or are not of blocks (n, 3, 3)"""

    def __init__(self, matrices: Sequence[ArrayLike]):
        self._matrices = [np.ascontiguousarray(each, np.float64) for each in matrices]
        self.blocks = len(self._matrices[0])
        if any(each.shape != (self.blocks, 3, 3) for each in self._matrices):
            self.blocks = 0

    def __len__(self) -> int:
        return len(self._matrices)

    def addresses(self) -> NDArray[np.uintp]:
        """Returns where each of them lies, (k,)."""
        return np.array([each.ctypes.data for each in self._matrices], np.uintp)

    def copy_to(self, target: Float64) -> None:
        """Copies all to rows of `target`, (k, 9 blocks)."""
        for row, matrix in zip(target, self._matrices, strict=True):
            row[:] = matrix.reshape(-1)


class Made(NamedTuple):
    """Values of L, (k, nonzeros), and which of them are good, (k,): those that are made without a remedy of one matrix
    alone. The others are to be made so."""

    values: NDArray[np.floating]
    good: NDArray[np.bool_]


class Begun(NamedTuple):
    """Matrices that are being factorized. end: waits for it. beside: a device does it, while this thread goes on"""

    end: Callable[[], Made]
    beside: bool
