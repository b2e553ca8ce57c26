# SPDX-License-Identifier: MIT
"""The libraries of precond_worker.factorize that run on the CPU."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from precond_worker.blocks import BLOCK, Index, noise
from precond_worker.elimination import eliminate
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.ordering import order_nodes
from precond_worker.packing import Packer
from precond_worker.supernodes import pattern_arrays
from precond_worker.triangle import lower_triangle
from protocol import FactorPattern
from protocol.check import all_finite


class Numeric(Protocol):
    """A library: L of block values, any csc_matrix that fits the pattern."""

    def factorize(self, values: NDArray[np.float64]) -> csc_matrix: ...

    def ldl(self, values: NDArray[np.float64]) -> tuple[csc_matrix, NDArray[np.float64], NDArray[np.float64]]: ...


class Host:
    """Factors of one block pattern by "cholmod" or "superlu"; `name` says which version."""

    def __init__(self, row_start: Index, columns: Index, library: str):
        tree = eliminate(row_start, columns, order_nodes(row_start, columns))
        self.pattern = FactorPattern.build(**pattern_arrays(tree))
        self.packer = Packer(self.pattern)
        self.name, self.numeric = numeric(library, lower_triangle(row_start, columns, tree.order))

    def factorize(
        self, matrix: NDArray[np.float64], dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Values of L (factorize.Analysis.factorize), computed in float64."""
        if not np.isfinite(matrix).all():
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        return self._packed(self.numeric.factorize(matrix), dtype, out)

    def turned(
        self, matrix: NDArray[np.float64], dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """Values of L |D|^1/2 of an LDL^T factorization of finite values, and how many pivots were not positive.

        Raises NotPositiveDefinite if there is none without pivoting, if pivots are noise (of a matrix that is singular
        but for rounding), or if L |D| L^T is more than `growth` times A.
        """
        unit, pivots, diagonal = self.numeric.ldl(matrix)
        scale = np.repeat(np.abs(diagonal).reshape(-1, BLOCK).max(axis=1), BLOCK)  # of its node
        if not (np.abs(pivots) > noise(dtype) * scale).all():
            raise NotPositiveDefinite("pivots of LDL^T are noise")
        values = unit.data * np.repeat(np.sqrt(np.abs(pivots)), np.diff(unit.indptr))
        lower = csc_matrix((values, unit.indices, unit.indptr), unit.shape)
        if not (np.asarray(lower.multiply(lower).sum(axis=1)).ravel() <= growth * scale).all():
            raise NotPositiveDefinite("LDL^T without pivoting grows out of hand")
        return self._packed(lower, dtype, None), int(np.count_nonzero(pivots < 0))

    def _packed(
        self, factor: csc_matrix, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        result = np.empty(self.pattern.nonzeros, dtype) if out is None else out
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            self.packer.pack(factor, result)
        self._check(result)
        return result

    def _check(self, result: NDArray[np.floating]) -> None:
        """Raises NotPositiveDefinite unless every value is finite and every pivot can be divided by."""
        pivots = result[self.pattern.diagonal]
        usable = (pivots >= np.finfo(result.dtype).tiny) & np.isfinite(pivots)
        if not usable.all():
            raise OutOfRange(f"pivot out of the range of {result.dtype}", int(np.argmin(usable)))
        if not all_finite(result):
            raise OutOfRange(f"factor out of the range of {result.dtype}")


def numeric(library: str, lower: csc_matrix) -> tuple[str, Numeric]:
    """Name with version, and the library at work on a numbered lower triangle."""
    if library == "cholmod":
        from precond_worker.cholmod import Cholmod, version

        return f"cholmod {version()}", Cholmod(lower)
    from precond_worker.superlu import SuperLU

    return "superlu", SuperLU(lower)
