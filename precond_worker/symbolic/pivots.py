# SPDX-License-Identifier: MIT
"""Tells whether pivots of complete factors are more than rounding error."""

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int64
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from protocol.factor import FactorPattern


class PivotCheck:
    """Compares pivots of L of one pattern with the diagonal of A.

    pattern: of L
    diagonal_blocks: place of the diagonal block of each node in A
    """

    def __init__(self, pattern: FactorPattern, diagonal_blocks: Int64):
        blocks = diagonal_blocks[pattern.permutation[::BLOCK] // BLOCK]  # of the nodes in the order of L
        self._entries = [BLOCK * BLOCK * blocks + (BLOCK + 1) * axis for axis in range(BLOCK)]
        self._pivots = [pattern.diagonal[axis::BLOCK] for axis in range(BLOCK)]

    def scales(self, matrices: Float64) -> Float64:
        """Returns the largest diagonal entry of each node, in the order of L, (k, nodes), of matrices (k, 9 blocks)."""
        largest = np.zeros((len(matrices), len(self._entries[0])))
        for entries in self._entries:
            np.maximum(largest, np.abs(matrices.take(entries, axis=1)), out=largest)
        return largest

    def sound(self, values: NDArray[np.floating], scales: Float64) -> NDArray[np.bool_]:
        """Returns whether all pivots of each factor, (k, nonzeros), are more than rounding error, (k,)."""
        least = values.take(self._pivots[0], axis=1)
        for places in self._pivots[1:]:
            np.minimum(least, values.take(places, axis=1), out=least)  # of positive numbers, or NaN
        pivots = least.astype(np.float64) ** 2
        sound: NDArray[np.bool_] = np.asarray((pivots > pivot_threshold(values.dtype) * scales).all(axis=1))
        return sound
