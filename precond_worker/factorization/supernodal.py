# SPDX-License-Identifier: MIT
"""Complete factors by native code of our own (native/multifrontal.cpp) on the BLAS that SciPy brings.

It is the default. Supernodes, and so the pattern of L, are those of CHOLMOD.
"""

import ctypes as c
import weakref
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int32, Int64
from precond_worker.errors import NotPositiveDefinite, OutOfRange
from precond_worker.factorization import blas
from precond_worker.many import Begun, Made, Matrices
from precond_worker.symbolic.assembly_tree import AssemblyTree, entries, maps
from precond_worker.symbolic.blocks import BLOCK, pivot_threshold
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from precond_worker.symbolic.supernodes import assembly_tree
from protocol.factor import FactorPattern

SOURCE = Path(__file__).with_name("native") / "multifrontal.cpp"
ROUGH = 1e-5  # least pivot over the diagonal of its node, below which float32 leaves less than two of its digits
DOUBTLESS = 2  # smallest pivot over the threshold of rounding errors, from where L after rounding is not looked at
MOST = 64  # matrices of a call
OPERATIONS = 2e7  # multiplications of a call, a millisecond or two: answers wait for all of its matrices
NOT_FINITE, PIVOT, RANGE, MEMORY = 1, 2, 3, 4  # enum Outcome; 0: made
ARRAYS = ("own", "height", "parent", "run_start", "run", "entry_start", "entry_block", "entry_row", "row_start", "rows")


class _Fronts(c.Structure):
    _fields_ = [("count", c.c_int64), ("nodes", c.c_int64), *((name, c.c_void_p) for name in ARRAYS)]


class _Result(c.Structure):
    _fields_ = [("outcome", c.c_int64), ("column", c.c_int64), ("negative", c.c_int64), ("least", c.c_double)]


@cache
def native() -> c.CDLL:
    """Compiled at the first call; raises sim_server.backends.compiler.CompileError without a C++ compiler."""
    from sim_server.backends.compiler import build  # lazily: CHOLMOD needs no compiler

    library, p, flag, functions = c.CDLL(str(build(SOURCE, stepping=False))), c.c_void_p, c.c_int32, blas.Library
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "mf_new": (p, [c.POINTER(_Fronts)]), "mf_delete": (None, [p]),
        "mf_factorize": (_Result, [p, p, c.c_int64, flag, flag, p, c.POINTER(functions)]),
        "mf_factorize_many": (
            None, [p, c.c_int64, p, c.c_int64, flag, c.c_double, p, c.c_int64, *[c.POINTER(functions)] * 2, p]
        ),
        "mf_signed": (_Result, [p, p, flag, p, p, c.POINTER(functions)]),
    }  # fmt: skip
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class SupernodalFactorization:
    """Factors of one block pattern on one thread. most: matrices that `begin_many` takes at a time, one after another

    Arithmetic is in the type of L. Where float32 leaves too few digits, of which the smallest pivot tells, the factor
    is made again in float64 and rounded.
    """

    name, together = "supernodal", 1

    def __init__(self, row_start: Int32, columns: Int32):
        tree = assembly_tree(eliminate(row_start, columns, order_nodes(row_start, columns)))
        self.pattern = FactorPattern.build(**tree.pattern_arrays())
        self._arrays = _arrays(tree, self.pattern, row_start, columns)  # the native code keeps their addresses
        self._diagonal = self._arrays["entry_block"][self._arrays["entry_start"][:-1]]  # block of each node of L
        self._native = native()
        fronts = _Fronts(len(tree.parent), len(tree.order), *(self._arrays[name].ctypes.data for name in ARRAYS))
        self.most = max(1, min(MOST, int(OPERATIONS / _operations(self.pattern))))
        self._work = self._native.mf_new(c.byref(fronts))
        if not self._work:
            raise MemoryError("no memory for a factorization")
        weakref.finalize(self, self._native.mf_delete, self._work)

    def factorize(
        self, matrix: Float64, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]:
        """Returns the values of L (factorize.Analysis.factorize)."""
        values = np.empty(self.pattern.nonzeros, dtype) if out is None else out
        if dtype == np.float32:
            made = self._make(matrix, values, single=True)
            if made.outcome == 0 and made.least > ROUGH:
                return values
        _check(self._make(matrix, values, single=False), dtype)
        return values

    def _make(self, matrix: Float64, values: NDArray[np.floating], single: bool) -> _Result:
        narrow, functions = values.dtype == np.float32, blas.library("s" if single else "d")
        result: _Result = self._native.mf_factorize(
            self._work, matrix.ctypes.data, len(matrix), single, narrow, values.ctypes.data, c.byref(functions)
        )
        return result

    def begin_many(self, matrices: Matrices, dtype: np.dtype[np.floating]) -> Begun:
        """Factorizes up to `most` matrices in one call of native code, with the values of L of `factorize`, to the bit.
        Those are good whose pivots leave no doubt."""
        count = len(matrices)
        values, least = np.empty((count, self.pattern.nonzeros), dtype), np.empty(count)
        at = matrices.addresses()
        self._native.mf_factorize_many(
            self._work, count, at.ctypes.data, matrices.blocks, dtype == np.float32, ROUGH, values.ctypes.data,
            self.pattern.nonzeros, c.byref(blas.library("s")), c.byref(blas.library("d")), least.ctypes.data,
        )  # fmt: skip
        made = Made(values, least > DOUBTLESS * pivot_threshold(dtype))
        return Begun(lambda: made, beside=False)

    def modified_ldl(
        self, matrix: Float64, dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]:
        """Returns the values of L |D|^1/2 of an LDL^T factorization, and the number of negative pivots.

        Raises NotPositiveDefinite if there is none without pivoting, if pivots are rounding error (as of a singular
        matrix), or if L |D| L^T is more than `growth` times A.
        """
        values, diagonal = np.empty(self.pattern.nonzeros, dtype), np.empty(self.pattern.size)
        made = self._native.mf_signed(
            self._work, matrix.ctypes.data, dtype == np.float32, values.ctypes.data, diagonal.ctypes.data,
            c.byref(blas.library("d")),
        )  # fmt: skip
        _check(made, dtype)
        if not made.least > pivot_threshold(dtype):
            raise NotPositiveDefinite("pivots of LDL^T are noise")
        scale = np.abs(np.diagonal(matrix[self._diagonal], axis1=1, axis2=2)).max(axis=1)
        if not (diagonal <= growth * np.repeat(scale, BLOCK)).all():
            raise NotPositiveDefinite("LDL^T without pivoting grows out of hand")
        return values, int(made.negative)


def _operations(pattern: FactorPattern) -> float:
    """Returns the multiplications of a factorization: half the sum of squares of the entries of L's columns."""
    rows, columns = np.diff(pattern.row_start).astype(float), np.diff(pattern.super_start).astype(float)
    below = rows - columns
    return float((columns * below**2 + below * columns**2 + columns**3 / 3).sum()) / 2


def _check(made: _Result, dtype: np.dtype[np.floating]) -> None:
    if made.outcome == NOT_FINITE:
        raise ValueError("matrix: values hold NaN or infinity, allowed: finite numbers")
    if made.outcome == PIVOT:
        raise NotPositiveDefinite("pivot not positive", made.column)
    if made.outcome == RANGE:
        raise OutOfRange(f"factor out of the range of {dtype}", made.column)
    if made.outcome == MEMORY:
        raise MemoryError("no memory for the fronts of a factorization")


def _arrays(
    tree: AssemblyTree, pattern: FactorPattern, row_start: Int32, columns: Int32
) -> dict[str, NDArray[np.integer]]:
    """Returns the arrays of struct Fronts."""
    start, block, row = entries(tree, row_start, columns)
    run_start, run = _runs(tree)
    return {
        "own": tree.own.astype(np.int32), "height": (np.diff(pattern.row_start) // BLOCK).astype(np.int32),
        "parent": tree.parent.astype(np.int32), "run_start": run_start, "run": run, "row_start": pattern.row_start,
        "rows": pattern.rows, "entry_start": start.astype(np.int64), "entry_block": block, "entry_row": row,
    }  # fmt: skip


def _runs(tree: AssemblyTree) -> tuple[Int64, Int32]:
    """Returns, for each front, runs of rows below its own that are adjacent in its parent too: (f + 1,), (runs, 2).

    A run is its place in the parent's rows and its length, in nodes.
    """
    at = maps(tree)
    begins = np.ones(len(at), bool)
    begins[1:] = at[1:] != at[:-1] + 1
    begins[tree.below_start[:-1][np.diff(tree.below_start) > 0]] = True
    first = np.flatnonzero(begins)
    length = np.diff(np.append(first, len(at)))
    run = np.stack([at[first], length], axis=1).astype(np.int32)
    return np.searchsorted(first, tree.below_start).astype(np.int64), run
