# SPDX-License-Identifier: MIT
"""Cholesky factors of one object: the symbolic phase once per topology, the numeric phase once per matrix."""

import os
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.sparse import csc_matrix

from precond_worker.blocks import BLOCK, checked_pattern
from precond_worker.elimination import eliminate
from precond_worker.errors import NotPositiveDefinite
from precond_worker.ordering import order_nodes
from precond_worker.packing import Packer
from precond_worker.supernodes import pattern_arrays
from precond_worker.triangle import lower_triangle
from protocol import FactorPattern
from protocol.check import all_finite

__all__ = ["CHOICE", "Analysis", "NotPositiveDefinite", "default_library"]

CHOICE = "WARPFACTOR_FACTORIZATION"  # environment: cholmod or superlu
SUPERLU_COST = "SciPy's SuperLU factorizes instead of CHOLMOD, 2 to 3 times slower, so factors are older by as much"


class Numeric(Protocol):
    """A library: L of block values, any csc_matrix that fits the pattern."""

    def factorize(self, values: NDArray[np.float64]) -> csc_matrix: ...


class Analysis:
    """Factors of matrices with one block pattern.

    pattern: supernodal pattern of L, the same for every matrix, every library and (given the same METIS) every machine
    library: "cholmod 3.0.14" or "superlu"

    The matrix is taken to be symmetric: of mirrored entries one is read and the other ignored (triangle.py says
    which). Not for use by several threads at once. Nothing here starts threads, but the BLAS under CHOLMOD may: run
    with OPENBLAS_NUM_THREADS=1, or results may differ in the last digits from run to run.
    """

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, library: str = "auto"):
        """row_start (nodes + 1,), columns (blocks,): block rows, both triangles, columns ascending.

        library: auto, cholmod or superlu. Raises ValueError if the pattern is none (blocks.py), ImportError if the
        library asked for is not installed.
        """
        start, column = checked_pattern(row_start, columns)
        self._blocks = len(column)
        tree = eliminate(start, column, order_nodes(start, column))
        self.pattern = FactorPattern.build(**pattern_arrays(tree))
        self._packer = Packer(self.pattern)
        self.library, self._numeric = numeric(library, lower_triangle(start, column, tree.order))

    def factorize(
        self, values: ArrayLike, dtype: DTypeLike = np.float32, out: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Values of L in the order of the pattern, (pattern.nonzeros,), float32 or float64.

        values: float64 (blocks, 3, 3). out: where to write them (it then says the type). Arithmetic is in float64;
        the same values give the same factor, bit by bit. Raises ValueError for values of another shape or not
        finite, NotPositiveDefinite; the next matrix may be fine.
        """
        matrix = np.ascontiguousarray(values, np.float64)
        if matrix.shape != (self._blocks, BLOCK, BLOCK):
            raise ValueError(f"matrix: values of shape {matrix.shape}, allowed: ({self._blocks}, {BLOCK}, {BLOCK})")
        if not np.isfinite(matrix).all():
            raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
        result = self._result(dtype, out)
        try:
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                self._packer.pack(self._numeric.factorize(matrix), result)
            self._check(result)
        except NotPositiveDefinite as error:
            raise NotPositiveDefinite(self._where(error), error.column) from None
        return result

    def _result(self, dtype: DTypeLike, out: NDArray[np.floating] | None) -> NDArray[np.floating]:
        kind = np.dtype(dtype) if out is None else out.dtype
        if kind not in (np.float32, np.float64):
            raise ValueError(f"factor: dtype {kind}, allowed: float32, float64")
        if out is None:
            return np.empty(self.pattern.nonzeros, kind)
        if out.shape != (self.pattern.nonzeros,):
            raise ValueError(f"factor: out of shape {out.shape}, allowed: ({self.pattern.nonzeros},)")
        return out

    def _check(self, result: NDArray[np.floating]) -> None:
        """Raises NotPositiveDefinite unless every value is finite and every pivot can be divided by."""
        pivots = result[self.pattern.diagonal]
        usable = (pivots >= np.finfo(result.dtype).tiny) & np.isfinite(pivots)
        if not usable.all():
            raise NotPositiveDefinite(f"pivot out of the range of {result.dtype}", int(np.argmin(usable)))
        if not all_finite(result):
            raise NotPositiveDefinite(f"factor out of the range of {result.dtype}")

    def _where(self, error: NotPositiveDefinite) -> str:
        if error.column < 0:
            return f"matrix: not positive definite ({error})"
        node, axis = divmod(int(self.pattern.permutation[error.column]), BLOCK)
        return f"matrix: not positive definite ({error} at node {node}, axis {'xyz'[axis]})"


def numeric(library: str, lower: csc_matrix) -> tuple[str, Numeric]:
    """Name with version, and the library at work on a numbered lower triangle."""
    name = default_library()[0] if library == "auto" else library
    if name == "cholmod":
        from precond_worker.cholmod import Cholmod, version

        return f"cholmod {version()}", Cholmod(lower)
    if name == "superlu":
        from precond_worker.superlu import SuperLU

        return "superlu", SuperLU(lower)
    raise ValueError(f"factorization library {name!r}, allowed: auto, cholmod, superlu")


def default_library() -> tuple[str, str]:
    """What "auto" stands for, and what is lost by it in one line (empty: nothing).

    The environment variable WARPFACTOR_FACTORIZATION forces one of them; raises ValueError if it names another.
    """
    forced = os.environ.get(CHOICE, "")
    if forced not in ("", "cholmod", "superlu"):
        raise ValueError(f"{CHOICE}={forced}, allowed: cholmod, superlu")
    if forced == "superlu":
        return "superlu", f"{CHOICE}=superlu: {SUPERLU_COST}"
    try:
        import sksparse.cholmod  # noqa: F401
    except ImportError as error:
        if not forced:
            return "superlu", f"pip install 'warpfactor[cholmod]' for CHOLMOD ({error}). {SUPERLU_COST}"
    return "cholmod", ""
