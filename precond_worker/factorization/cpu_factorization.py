# SPDX-License-Identifier: MIT
"""Complete factorizations on the CPU, by CHOLMOD or SuperLU."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from precond_worker.arrays import Float64, Int32
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.factorization.permuted_csc import lower_triangle
from precond_worker.factorization.to_supernodal import Packer
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from precond_worker.symbolic.supernodes import pattern_arrays
from protocol.factor import FactorPattern
from protocol.validate import all_finite


class NumericLibrary(Protocol):
    """CHOLMOD or SuperLU; L is any csc_matrix that fits the pattern."""

    def factorize(self, values: Float64) -> csc_matrix: ...

    def ldl(self, values: Float64) -> tuple[csc_matrix, Float64, Float64]: ...


class CpuFactorization:
    """Factors of one block pattern by "cholmod" or "superlu". name: library and version."""

    def __init__(self, row_start: Int32, columns: Int32, library: str):
        tree = eliminate(row_start, columns, order_nodes(row_start, columns))
        self.pattern = FactorPattern.build(**pattern_arrays(tree))
        self.packer = Packer(self.pattern)
        self.name, self.numeric = open_library(library, lower_triangle(row_start, columns, tree.order))

    def factorize(
        self, matrix: Float64, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Returns the values of L (factorize.Analysis.factorize), computed in float64."""
        if not np.isfinite(matrix).all():
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        return self._packed(self.numeric.factorize(matrix), dtype, out)

    def modified_ldl(
        self, matrix: Float64, dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """Returns the values of L |D|^1/2 of an LDL^T factorization, and the number of negative pivots.

        Raises NotPositiveDefinite if there is none without pivoting, if pivots are rounding error (as of a singular
        matrix), or if L |D| L^T is more than `growth` times A.
        """
        unit, pivots, diagonal = self.numeric.ldl(matrix)
        scale = np.repeat(np.abs(diagonal).reshape(-1, BLOCK).max(axis=1), BLOCK)  # of the node of each row
        if not (np.abs(pivots) > pivot_threshold(dtype) * scale).all():
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


def open_library(library: str, lower: csc_matrix) -> tuple[str, NumericLibrary]:
    """Returns name with version, and the library for a numbered lower triangle."""
    if library == "cholmod":
        from precond_worker.factorization.cholmod import Cholmod, version

        return f"cholmod {version()}", Cholmod(lower)
    from precond_worker.factorization.superlu import SuperLU

    return "superlu", SuperLU(lower)
