# SPDX-License-Identifier: MIT
"""Numeric factorization by CHOLMOD, through scikit-sparse 0.4."""

import ctypes

import numpy as np
from scipy.sparse import csc_matrix
from sksparse import cholmod

from precond_worker.arrays import Float64
from precond_worker.errors import NotPositiveDefinite
from precond_worker.factorization.permuted_csc import PermutedMatrix


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
