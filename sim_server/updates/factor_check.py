# SPDX-License-Identifier: MIT
"""A factor is looked at before it is used: one application to a fixed vector, in the service thread.

With z = P^-1 r the first iteration of conjugate gradients takes (z.r)^2 / (z.Az) off e.Ae, the energy of the error
(Saad, Iterative Methods for Sparse Linear Systems, 2nd edition, 5.3.1), whatever scale P has. An exact factor takes off
all of it; a factor that takes off less than block Jacobi does is worth less than what costs nothing.
"""

import ctypes as c
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.compiler import native
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.engine import NativeFactor

Reals = NDArray[np.float64]
SHARE = 0.9  # of what block Jacobi takes off: below it a factor is refused; not 1, as one vector is not the whole space


@cache
def _library() -> c.CDLL:
    p = c.c_void_p
    arguments = [c.POINTER(structs.Factor), c.c_int32, p, p, p, p, p, p]
    signatures: dict[str, tuple[Any, list[Any]]] = {"wf_judge": (None, arguments), "wf_sizes": (c.c_int32, [p])}
    library = native("backends/cpu/native/factor_check.cpp", signatures, stepping=False)
    sizes = (c.c_int32 * 2)()
    library.wf_sizes(sizes)
    structs.check_sizes(
        "backends/cpu/native/factor_check.cpp", list(sizes), [c.sizeof(structs.Factor), c.sizeof(structs.Pattern)]
    )
    return library


class Guard:
    """patterns: row_start and columns of A by object, nodes numbered from 0."""

    def __init__(self, patterns: dict[str, tuple[NDArray[np.int32], NDArray[np.int32]]]):
        self._patterns = patterns
        self._room: dict[int, tuple[Reals, Reals]] = {}  # by size: probe vector, work

    def prepare(self) -> None:
        """Compiles what is needed, so that the first factor does not wait for it."""
        _library()

    def complaint(self, factor: Factor, matrix: Reals | None) -> str:
        """Why a factor is not to be used, empty if it is. matrix: values (blocks, 3, 3) it was made from, if known."""
        row_start, columns = self._patterns[factor.object]
        nodes = len(row_start) - 1
        if factor.pattern.size != 3 * nodes:
            return f"its size is {factor.pattern.size}, that of the object {3 * nodes}"
        if len(factor.values) != factor.pattern.nonzeros:
            return f"it has {len(factor.values)} values, its pattern {factor.pattern.nonzeros}"
        zr, reached, block_jacobi = self._judge(factor, nodes, row_start, columns, matrix)
        if not 0 < zr < np.inf:
            return f"not positive definite or not finite (z.r = {zr:.3g} on a probe vector)"
        if matrix is not None and not reached >= SHARE * block_jacobi:
            return (
                "worse than block Jacobi on a probe vector: an iteration takes "
                f"{reached:.3g} off the energy of the error, with block Jacobi {block_jacobi:.3g}"
            )
        return ""

    def _judge(
        self, factor: Factor, nodes: int, row_start: NDArray[Any], columns: NDArray[Any], matrix: Reals | None
    ) -> tuple[float, float, float]:
        """z.r, and (z.r)^2 / z.Az with the factor and with block Jacobi (0 where A is not positive definite)."""
        n = 3 * nodes
        if n not in self._room:
            self._room[n] = np.random.default_rng(0).standard_normal(n), np.empty(8 * n)
        r, work = self._room[n]
        seen, out = NativeFactor(factor.pattern, np.ascontiguousarray(factor.values), factor.step), np.zeros(4)
        values = None if matrix is None else matrix.ctypes.data
        _library().wf_judge(
            c.byref(seen.native), nodes, row_start.ctypes.data, columns.ctypes.data, values, r.ctypes.data,
            work.ctypes.data, out.ctypes.data,
        )  # fmt: skip
        energy = [zr * zr / za if za > 0 else 0.0 for zr, za in (out[:2], out[2:])]
        return float(out[0]), energy[0], energy[1]
