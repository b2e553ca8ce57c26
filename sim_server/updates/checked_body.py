# SPDX-License-Identifier: MIT
"""What native code needs to check factors (backends/cpu/native/factor_check.cpp): its library, and bodies."""

import ctypes as c
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from protocol.validate import helping_threads
from sim_server.arrays import Int32
from sim_server.backends.compiler import native
from sim_server.backends.cpu.factors import NativePattern
from sim_server.backends.declarations import Declarations

SOURCE = "backends/cpu/native/factor_check.cpp"
TEXT = Declarations(SOURCE)
FACTOR, ARRIVING = TEXT.dtype("Factor"), TEXT.dtype("ArrivingFactor")
WORK = 9  # numbers for each degree of freedom
FEW = 8  # factors for each thread, at least


@cache
def library() -> c.CDLL:
    """Compiles and loads it. Raises CompileError."""
    i, n, p = c.c_int32, c.c_int64, c.c_void_p
    signatures = {"wf_judge_all": (None, [i, i, *[p] * 9, n, i]), "wf_take_in": (None, [p, i, p, p, p, n, i])}
    made = native(SOURCE, signatures, stepping=False)
    TEXT.check_sizes(made)
    return made


def sharing_threads(factors: int) -> int:
    """Number of threads that share so many factors."""
    return 1 + min(helping_threads(), factors // FEW)


class CheckedBodies(NamedTuple):
    """What the check needs of the objects of some factors, by columns.

    columns: addresses of row_start, columns, probe vector and pattern of the factor of each, and its nodes, (k, 5)
    kept: what they are addresses of
    """

    columns: NDArray[np.uintp]
    kept: Sequence["CheckedBody"]


class CheckedBody:
    """What the check needs of an object: its pattern, that of its factor, and where native code finds them.

    row: of the table of those that are known
    native: a row of CheckedBodies.columns
    """

    def __init__(self, row_start: Int32, columns: Int32, probe: NDArray[np.float64], pattern: FactorPattern, row: int):
        self.row_start, self.columns, self.probe, self.pattern, self.row = row_start, columns, probe, pattern, row
        self.nodes, self.nonzeros, self._native = len(row_start) - 1, pattern.nonzeros, NativePattern(pattern)
        arrays = (each.ctypes.data for each in (row_start, columns, probe))
        self.native = (*arrays, c.addressof(self._native.native), self.nodes)

    def fits(self, row_start: Int32, columns: Int32, pattern: FactorPattern) -> bool:
        """True if the arrays are still those."""
        return self.row_start is row_start and self.columns is columns and self.pattern is pattern
