# SPDX-License-Identifier: MIT
"""Checks a factor before it is used: one application to a fixed vector, in the service thread.

With z = P^-1 r the first iteration of conjugate gradients takes (z.r)^2 / (z.Az) off e.Ae, the energy of the error
(Saad, Iterative Methods for Sparse Linear Systems, 2nd edition, 5.3.1), whatever scale P has. An exact factor takes off
all of it; a factor that takes off less than block Jacobi does is worth less than what costs nothing.
"""

import ctypes as c
import threading
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.compiler import native
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.engine import NativeFactor
from sim_server.updates.patterns import Patterns

Reals = NDArray[np.float64]
MAX_RESIDUAL = 0.05  # |r - A P^-1 r| / |r| of a factor that is to take the place of A; exact ones in float32 have 1e-3
MIN_SHARE = 0.9  # of what block Jacobi takes off, for a factor to be used; not 1, as one vector is not the space


class Probe(NamedTuple):
    """What an application z = P^-1 r shows; without a matrix only z.r.

    zr: z.r
    reduction, block_jacobi: (z.r)^2 / z.Az, the energy that an iteration takes off with the factor and with block
        Jacobi (0 if A is not positive definite)
    residual: |r - A z| / |r|
    """

    zr: float
    reduction: float
    block_jacobi: float
    residual: float


@cache
def _library() -> c.CDLL:
    p = c.c_void_p
    arguments = [c.POINTER(structs.Factor), c.c_int32, p, p, p, p, p, p]
    library = native("backends/cpu/native/factor_check.cpp", {"wf_judge": (None, arguments)}, stepping=False)
    structs.LOOP.check_sizes(library)
    return library


class FactorCheck:
    """Checks factors of some objects.

    patterns: row_start and columns of A by object, nodes numbered from 0, or those of all epochs
    alone: factors are to take the place of A, so they must be exact
    """

    def __init__(
        self, patterns: Patterns | Mapping[str, tuple[NDArray[np.int32], NDArray[np.int32]]], alone: bool = False
    ):
        self._patterns, self._alone = patterns if isinstance(patterns, Patterns) else Patterns(patterns), alone
        self._arrays: dict[int, tuple[Reals, Reals]] = {}  # by size: probe vector, work
        self._lock = threading.Lock()  # of these

    def prepare(self) -> None:
        """Compiles the native check, so that the first factor does not wait for it."""
        _library()

    def reject_reason(self, factor: Factor, matrix: Reals | None) -> str:
        """Returns why a factor is not to be used; empty if it is.

        matrix: values (blocks, 3, 3) that it was made from; None: not known, and the test against block Jacobi is left
            out
        """
        nodes = len(self._patterns.at(factor.object, factor.epoch)[0]) - 1
        if factor.pattern.size != 3 * nodes:
            return f"its size is {factor.pattern.size}, that of the object {3 * nodes}"
        if len(factor.values) != factor.pattern.nonzeros:
            return f"it has {len(factor.values)} values, its pattern {factor.pattern.nonzeros}"
        zr, reduction, block_jacobi, residual = self.probe(factor, matrix)
        if not 0 < zr < np.inf:
            return f"not positive definite or not finite (z.r = {zr:.3g} on a probe vector)"
        if matrix is not None and not reduction >= MIN_SHARE * block_jacobi:
            return (
                "worse than block Jacobi on a probe vector: an iteration takes "
                f"{reduction:.3g} off the energy of the error, with block Jacobi {block_jacobi:.3g}"
            )
        if self._alone and matrix is not None and not factor.remedy and not residual <= MAX_RESIDUAL:
            return (
                f"not that of its matrix: it leaves {residual:.3g} of a residual, at most {MAX_RESIDUAL:g} is allowed"
            )
        return ""

    def probe(self, factor: Factor, matrix: Reals | None) -> Probe:
        """Applies a factor, which has the right size, to the probe vector r. From any thread."""
        with self._lock:
            return self._probe(factor, matrix)

    def _probe(self, factor: Factor, matrix: Reals | None) -> Probe:
        row_start, columns = self._patterns.at(factor.object, factor.epoch)
        nodes = len(row_start) - 1
        n = 3 * nodes
        if n not in self._arrays:
            self._arrays[n] = np.random.default_rng(0).standard_normal(n), np.empty(8 * n)
        r, work = self._arrays[n]
        native_factor = NativeFactor(factor.pattern, np.ascontiguousarray(factor.values), factor.step)
        out = np.zeros(5)
        values = None if matrix is None else matrix.ctypes.data
        _library().wf_judge(
            c.byref(native_factor.native), nodes, row_start.ctypes.data, columns.ctypes.data, values, r.ctypes.data,
            work.ctypes.data, out.ctypes.data,
        )  # fmt: skip
        energy = [zr * zr / za if za > 0 else 0.0 for zr, za in (out[:2], out[2:4])]
        return Probe(float(out[0]), energy[0], energy[1], float(out[4]))
