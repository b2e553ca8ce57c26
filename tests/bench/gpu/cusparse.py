# SPDX-License-Identifier: MIT
"""cuSPARSE's products and triangular solves, as they go at their best: prepared once, called many times."""

import ctypes
import time
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from sim_server.backends.gpu.device import cupy

FILL_MODE, LOWER, UPPER = 0, 0, 1  # of cuSPARSE


def device_csr(matrix: Any, dtype: Any) -> Any:
    """On the device, int32 indices."""
    import cupyx.scipy.sparse as sparse

    host = csr_matrix(matrix)
    cp = cupy()
    parts = (cp.asarray(host.data, dtype), cp.asarray(host.indices, np.int32), cp.asarray(host.indptr, np.int32))
    return sparse.csr_matrix(parts, shape=host.shape)


class CuSparse:
    """Functions of cuSPARSE on the current stream, which CuPy's bindings do not have, or not within a graph."""

    def __init__(self) -> None:
        from cupy.cuda.device import get_cusparse_handle

        self._library, self._handle = ctypes.CDLL("libcusparse.so.12"), ctypes.c_void_p(get_cusparse_handle())

    def __call__(self, name: str, *arguments: Any, handle: bool = True) -> None:
        if handle:
            stream = cupy().cuda.get_current_stream().ptr
            self._library.cusparseSetStream(self._handle, ctypes.c_void_p(stream))
            arguments = (self._handle, *arguments)
        if status := getattr(self._library, f"cusparse{name}")(*arguments):
            raise RuntimeError(f"cusparse{name}: status {status}")


def _descriptors(matrix: Any, *vectors: Any) -> list[ctypes.c_void_p]:
    from cupy_backends.cuda.libs import cusparse

    real, int32 = _real(matrix), 2
    pointers = (matrix.indptr.data.ptr, matrix.indices.data.ptr, matrix.data.data.ptr)
    made = [cusparse.createCsr(*matrix.shape, matrix.nnz, *pointers, int32, int32, 0, real)]
    made += [cusparse.createDnVec(len(v), v.data.ptr, real) for v in vectors]
    return [ctypes.c_void_p(m) for m in made]


def _real(matrix: Any) -> int:
    return 0 if matrix.dtype == np.float32 else 1


def _pointer(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data if isinstance(array, np.ndarray) else array.data.ptr)


class Product:
    """y = matrix x by cuSPARSE's SpMV."""

    def __init__(self, matrix: Any, x: Any, y: Any):
        self._call, self._kept, size = CuSparse(), (matrix, x, y), ctypes.c_size_t()
        self._one, self._zero = np.ones(1, matrix.dtype), np.zeros(1, matrix.dtype)
        a, u, v = _descriptors(matrix, x, y)
        self._arguments = (0, _pointer(self._one), a, u, _pointer(self._zero), v, _real(matrix), 0)
        self._call("SpMV_bufferSize", *self._arguments, ctypes.byref(size))
        self._buffer = cupy().empty(max(size.value, 16), np.int8)

    def __call__(self) -> None:
        self._call("SpMV", *self._arguments, _pointer(self._buffer))


class Triangle:
    """A triangular solve by cuSPARSE's SpSV, analysed. fill: LOWER or UPPER. ms: of the analysis."""

    def __init__(self, matrix: Any, x: Any, y: Any, fill: int):
        from cupy_backends.cuda.libs import cusparse

        self._call, self._kept, size = CuSparse(), (matrix, x, y), ctypes.c_size_t()
        a, u, v = _descriptors(matrix, x, y)
        cusparse.spMatSetAttribute(a.value, FILL_MODE, fill)
        self._one, self._descriptor = np.ones(1, matrix.dtype), ctypes.c_void_p()
        self._call("SpSV_createDescr", ctypes.byref(self._descriptor), handle=False)
        self._arguments = (0, _pointer(self._one), a, u, v, _real(matrix), 0, self._descriptor)
        self._call("SpSV_bufferSize", *self._arguments, ctypes.byref(size))
        self._buffer = cupy().empty(max(size.value, 16), np.int8)
        begin = time.perf_counter()
        self._call("SpSV_analysis", *self._arguments, _pointer(self._buffer))
        cupy().cuda.Device().synchronize()
        self.ms = 1e3 * (time.perf_counter() - begin)

    def __call__(self) -> None:
        self._call("SpSV_solve", *self._arguments)
