# SPDX-License-Identifier: MIT
"""What others do with the same matrices on the same GPU. Each returns one row, or says in it why there is none.

cuSPARSE: z = L^-T L^-1 r with the L that our server has, float32, both triangular solves (SpSV; L^T stored as rows of
its own, which is what it does best). Sparse inverse: W = L^-1 made explicit, z = W^T (W r), two products. CuPy: its cg
in float64. cuDSS: refactorization and solution with the pattern analysed before, float64 and float32.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from protocol.factor import FactorPattern
from sim_server.backends.gpu.device import cupy
from tests.bench.gpu import cudss
from tests.bench.gpu.cusparse import LOWER, UPPER, Product, Triangle, device_csr
from tests.bench.gpu.device import timed, timed_in_graph
from tests.bench.gpu.steps import Sample

LARGEST = {  # tets; beyond them these take memory or minutes, and are out anyway
    "cuSPARSE L, then its transpose": 24_000,
    "sparse L^-1, two products": 7350,
    "cupyx cg": 98_304,
    "cuDSS, float64": 1_029_000,
    "cuDSS, float32": 405_600,
}

Row = dict[str, Any]


def lower(pattern: FactorPattern, values: np.ndarray) -> csc_matrix:
    """L, (n, n), from its values in the order of the pattern."""
    start = np.append(pattern.diagonal, pattern.nonzeros).astype(np.int64)
    supernode = np.repeat(np.arange(len(pattern.super_start) - 1), np.diff(pattern.super_start))
    first = pattern.row_start[supernode] + np.arange(pattern.size) - pattern.super_start[supernode]
    place = np.arange(pattern.nonzeros) + np.repeat(first - start[:-1], np.diff(start))
    return csc_matrix((values, pattern.rows[place], start), shape=(pattern.size, pattern.size))


def triangular(sample: Sample, times: int) -> Row:
    """One application of the factor by two triangular solves."""
    cp = cupy()
    factor = lower(sample.pattern, sample.factor)  # type: ignore[arg-type]
    r, y, z = (cp.zeros(sample.b.size, np.float32) for _ in range(3))
    r[:] = cp.asarray(sample.b.ravel()[sample.pattern.permutation], np.float32)  # type: ignore[union-attr]
    forward = Triangle(device_csr(factor, np.float32), r, y, LOWER)
    backward = Triangle(device_csr(factor.T, np.float32), y, z, UPPER)

    def apply() -> None:
        forward()
        backward()

    us = timed(apply, times)
    return {"us": us, "residual": _applied(sample, z.get()), "prepared ms": forward.ms + backward.ms}


def sparse_inverse(sample: Sample, times: int) -> Row:
    """One application of the factor by two products with the explicit inverse of L."""
    from cupyx.scipy.linalg import solve_triangular

    cp = cupy()
    factor = lower(sample.pattern, sample.factor).toarray()  # type: ignore[arg-type]
    begin = time.perf_counter()
    dense = solve_triangular(cp.asarray(factor), cp.eye(len(factor), dtype=factor.dtype), lower=True).get()
    inverse = csr_matrix(dense)
    ms = 1e3 * (time.perf_counter() - begin)
    r, y, z = (cp.zeros(sample.b.size, np.float32) for _ in range(3))
    r[:] = cp.asarray(sample.b.ravel()[sample.pattern.permutation], np.float32)  # type: ignore[union-attr]
    forward = Product(device_csr(inverse, np.float32), r, y)
    backward = Product(device_csr(inverse.T, np.float32), y, z)

    def apply() -> None:
        forward()
        backward()

    us = timed_in_graph(apply, times)
    return {"us": us, "residual": _applied(sample, z.get()), "prepared ms": ms}


def _applied(sample: Sample, z: np.ndarray) -> float:
    y = np.empty(len(z))
    y[sample.pattern.permutation] = z  # type: ignore[union-attr]
    return sample.residual(y)


def cupyx_cg(sample: Sample, times: int) -> Row:
    """A whole solve from zero by CuPy's cg, float64, 1e-6."""
    from cupyx.scipy.sparse.linalg import cg

    cp = cupy()
    a, b, seen = device_csr(sample.matrix(), np.float64), cp.asarray(sample.b.ravel()), []
    x, _ = cg(a, b, rtol=1e-6, maxiter=5000, callback=lambda _: seen.append(1))
    us = timed(lambda: cg(a, b, rtol=1e-6, maxiter=5000), max(1, times // 50))
    return {"us": us, "iterations": len(seen), "residual": sample.residual(x.get())}


def direct(dtype: Any, sample: Sample, times: int) -> Row:
    """cuDSS: a factorization and a solution, as each step would need them."""
    return cudss.measured(sample, dtype, max(3, times // 10))


WAYS: dict[str, Callable[[Sample, int], Row]] = {
    "cuSPARSE L, then its transpose": triangular,
    "sparse L^-1, two products": sparse_inverse,
    "cupyx cg": cupyx_cg,
    "cuDSS, float64": partial(direct, np.float64),
    "cuDSS, float32": partial(direct, np.float32),
}


def compared(sample: Sample, tets: int, material: str, times: int = 50) -> list[Row]:
    """All of them that make sense at this size."""
    rows = []
    for name, way in WAYS.items():
        if tets > LARGEST[name] or (sample.factor is None and way in (triangular, sparse_inverse)):
            continue
        try:
            row = way(sample, times)
        except Exception as error:  # one that fails says so; the others go on
            row = {"remark": f"{type(error).__name__}: {error}".splitlines()[0]}
        rows.append({"tets": tets, "material": material, "what": name, **row})
        cupy().get_default_memory_pool().free_all_blocks()
        print(rows[-1], flush=True)
    return rows
