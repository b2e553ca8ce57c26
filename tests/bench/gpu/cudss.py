# SPDX-License-Identifier: MIT
"""NVIDIA's direct solver cuDSS through nvmath-python, where that is installed."""

import time
from importlib import metadata
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, tril

from sim_server.backends.gpu.device import cupy
from tests.bench.gpu.device import timed
from tests.bench.gpu.steps import Sample

ABSENT = "cuDSS: not installed (pip install 'nvmath-python[cu13]')"


def version() -> str:
    """Of cuDSS and nvmath-python; "absent"."""
    try:
        from nvmath.bindings import cudss

        number = ".".join(str(cudss.get_property(part)) for part in range(3))
        return f"{number} through nvmath-python {metadata.version('nvmath-python')}"
    except Exception as error:  # not there, or there without what it needs
        print(f"cuDSS: {error}", flush=True)
        return "absent"


class Direct:
    """A sparse symmetric positive definite system, analysed and factorized once."""

    def __init__(self, matrix: csr_matrix, b: np.ndarray, dtype: Any):
        from nvmath.bindings import cudss

        cp, self.cudss, n = cupy(), cudss, matrix.shape[0]
        triangle = csr_matrix(tril(matrix))
        triangle.sort_indices()
        parts = (triangle.indptr.astype(np.int32), triangle.indices.astype(np.int32), triangle.data.astype(dtype))
        start, columns, values = self._arrays = tuple(cp.asarray(part) for part in parts)
        self.b, self.x = cp.asarray(b, dtype), cp.zeros(n, dtype)
        int32, real = cudss.DataType.R_32I, cudss.DataType.R_32F if dtype == np.float32 else cudss.DataType.R_64F
        self._handle, self._config = cudss.create(), cudss.config_create()
        cudss.set_stream(self._handle, cp.cuda.get_current_stream().ptr)
        self._data = cudss.data_create(self._handle)
        types = (int32, int32, real, cudss.MatrixType.SPD, cudss.MatrixViewType.LOWER, cudss.IndexBase.ZERO)
        pointers = (start.data.ptr, 0, columns.data.ptr, values.data.ptr)
        self._a = cudss.matrix_create_csr(n, n, len(values), *pointers, *types)
        layout = cudss.Layout.COL_MAJOR
        self._x, self._b = (cudss.matrix_create_dn(n, 1, n, v.data.ptr, real, layout) for v in (self.x, self.b))
        self.run(cudss.Phase.ANALYSIS)
        self.run(cudss.Phase.FACTORIZATION)
        cp.cuda.Device().synchronize()

    def run(self, phase: int) -> None:
        """One phase on the current stream."""
        self.cudss.execute(self._handle, phase, self._config, self._data, self._a, self._x, self._b)

    def step(self) -> None:
        """What each time step needs: the factors of new values, and a solution."""
        self.run(self.cudss.Phase.REFACTORIZATION)
        self.run(self.cudss.Phase.SOLVE)

    def close(self) -> None:
        """Gives its memory back."""
        for matrix in (self._a, self._x, self._b):
            self.cudss.matrix_destroy(matrix)
        self.cudss.data_destroy(self._handle, self._data)
        self.cudss.config_destroy(self._config)
        self.cudss.destroy(self._handle)


def measured(sample: Sample, dtype: Any, times: int) -> dict[str, Any]:
    """us of refactorization and solution, the true residual, ms of the first analysis and factorization."""
    try:
        from nvmath.bindings import cudss  # noqa: F401
    except ImportError:
        return {"remark": ABSENT}
    begin = time.perf_counter()
    direct = Direct(csr_matrix(sample.matrix()), sample.b.ravel(), dtype)
    ms = 1e3 * (time.perf_counter() - begin)
    try:
        us = timed(direct.step, times)
        return {"us": us, "residual": sample.residual(direct.x.get()), "prepared ms": ms}
    finally:
        direct.close()
