# SPDX-License-Identifier: MIT
"""Tells whether pivots of complete factors are more than rounding error."""

import ctypes as c
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int64
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from precond_worker.symbolic.compiled import compiled
from protocol.factor import FactorPattern

SOURCE = Path(__file__).with_suffix(".cpp")


@cache
def native() -> c.CDLL | None:
    """Returns the library; None where it is not to be had."""
    library, p, n = compiled(SOURCE), c.c_void_p, c.c_int64
    if library is not None:
        library.pivot_scales.restype = library.pivots_sound.restype = None
        library.pivot_scales.argtypes = [n, n, p, n, p, p]
        library.pivots_sound.argtypes = [n, n, p, c.c_int32, n, p, p, c.c_double, p]
    return library


class PivotCheck:
    """Compares pivots of L of one pattern with the diagonal of A, by native code where it is to be had.

    pattern: of L
    diagonal_blocks: place of the diagonal block of each node in A
    """

    def __init__(self, pattern: FactorPattern, diagonal_blocks: Int64):
        self._library = native()
        nodes = pattern.permutation[::BLOCK] // BLOCK  # in the order of L
        self._blocks = np.ascontiguousarray(diagonal_blocks[nodes], np.int64)
        self._places = np.ascontiguousarray(pattern.diagonal, np.int64)
        self._least = BLOCK * BLOCK * (int(self._blocks.max()) + 1)  # numbers of a matrix
        self._nonzeros = pattern.nonzeros

    def scales(self, matrices: Float64) -> Float64:
        """Returns the largest diagonal entry of each node, in the order of L, (k, nodes), of matrices (k, 9 blocks).
        Raises ValueError for arrays that native code must not read."""
        count, size = matrices.shape
        if matrices.dtype != np.float64 or not matrices.flags.c_contiguous or size < self._least:
            raise ValueError(
                f"matrices of {size} numbers of {matrices.dtype}; allowed: float64, at least {self._least}"
            )
        if self._library is None:
            entries = matrices.reshape(count, -1, BLOCK * BLOCK)[:, self._blocks, :: BLOCK + 1]
            return np.ascontiguousarray(np.abs(entries).max(axis=2))
        found = np.empty((count, len(self._blocks)))
        blocks = self._blocks.ctypes.data
        self._library.pivot_scales(count, size, matrices.ctypes.data, len(self._blocks), blocks, found.ctypes.data)
        return found

    def sound(self, values: NDArray[np.floating[Any]], scales: Float64) -> NDArray[np.bool_]:
        """Returns whether all pivots of each factor, (k, nonzeros), are more than rounding error, (k,). Raises as
        `scales`."""
        count, size, threshold = *values.shape, pivot_threshold(values.dtype)
        if values.dtype not in (np.float32, np.float64) or not values.flags.c_contiguous or size != self._nonzeros:
            raise ValueError(f"factors of {size} numbers of {values.dtype}; allowed: {self._nonzeros}, contiguous")
        if scales.shape != (count, len(self._blocks)) or not (scales.dtype == np.float64 and scales.flags.c_contiguous):
            raise ValueError(f"scales {scales.shape} of {scales.dtype}; allowed: {(count, len(self._blocks))}, float64")
        if self._library is None:
            pivots = values[:, self._places].astype(np.float64).reshape(count, -1, BLOCK) ** 2
            return np.asarray((pivots > threshold * scales[:, :, None]).all(axis=(1, 2)))
        good = np.empty(count, np.bool_)
        self._library.pivots_sound(
            count, size, values.ctypes.data, values.itemsize, len(self._blocks), self._places.ctypes.data,
            scales.ctypes.data, threshold, good.ctypes.data,
        )  # fmt: skip
        return good
