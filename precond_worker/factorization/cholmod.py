# SPDX-License-Identifier: MIT
"""Complete factors by CHOLMOD, through scikit-sparse 0.4."""

import ctypes

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from sksparse import cholmod

from precond_worker.arrays import Float64, Int32
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.factorization.permuted_csc import PermutedMatrix, lower_triangle
from precond_worker.factorization.to_supernodal import Packer
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from precond_worker.symbolic.supernodes import assembly_tree
from protocol.factor import FactorPattern
from protocol.validate import all_finite


class CholmodFactorization:
    """Factors of one block pattern. name: library and version, e.g. "cholmod 3.0.14"."""

    def __init__(self, row_start: Int32, columns: Int32):
        tree = eliminate(row_start, columns, order_nodes(row_start, columns))
        self.pattern = FactorPattern.build(**assembly_tree(tree).pattern_arrays())
        self.packer = Packer(self.pattern)
        self.numeric = Cholmod(lower_triangle(row_start, columns, tree.order))
        self.name = f"cholmod {version()}"

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


class Cholmod:
    """Supernodal LL^T of matrices of one pattern, in their natural order.

    Always supernodal: CHOLMOD's simplicial method is 4 to 15 times slower on meshes of tetrahedra.
    """

    def __init__(self, lower: csc_matrix):
        """lower: numbered lower triangle (permuted_csc.py) in the order of elimination."""
        self._matrix = PermutedMatrix(lower)
        self._factor = cholmod.analyze(self._matrix.matrix, mode="supernodal", ordering_method="natural")
        if not np.array_equal(self._factor.P(), np.arange(lower.shape[0])):
            raise RuntimeError("CHOLMOD permuted a matrix that it was to factorize in its natural order")

    def factorize(self, values: Float64) -> csc_matrix:
        """Returns L of the block values (blocks, 3, 3), which the next call leaves as it is.

        Raises NotPositiveDefinite with the column in `column`; the object stays usable.
        """
        try:
            self._factor.cholesky_inplace(self._matrix.fill(values))
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise NotPositiveDefinite("pivot not positive", column=int(error.column)) from None
        return self._factor.L()

    def ldl(self, values: Float64) -> tuple[csc_matrix, Float64, Float64]:
        """Returns L with a unit diagonal, D (n,) of any sign and the diagonal of the matrix.

        By the simplicial method, as CHOLMOD's supernodal one has no D. Raises NotPositiveDefinite if a pivot is zero.
        """
        matrix = self._matrix.fill(values)
        factor = cholmod.analyze(matrix, mode="simplicial", ordering_method="natural")
        try:
            factor.cholesky_inplace(matrix)
        except cholmod.CholmodNotPositiveDefiniteError as error:
            raise NotPositiveDefinite("pivot zero", column=int(error.column)) from None
        unit, pivots = factor.L_D()
        return csc_matrix(unit), pivots.diagonal(), matrix.diagonal()


def version() -> str:
    """Returns the version of the CHOLMOD library, e.g. "3.0.14"."""
    number = (ctypes.c_int * 3)()
    ctypes.CDLL(cholmod.__file__).cholmod_version(number)  # found among the libraries that the module is linked with
    return ".".join(map(str, number))
