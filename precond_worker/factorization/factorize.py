# SPDX-License-Identifier: MIT
"""Cholesky factors of one object: the symbolic phase once per topology, the numeric phase once per matrix."""

import os
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from precond_worker.arrays import Float64, Int32, Int64
from precond_worker.errors import NotPositiveDefinite
from precond_worker.many import Begun, Matrices
from precond_worker.symbolic.blocks import BLOCK, checked_pattern
from protocol.factor import FactorPattern

__all__ = ["CHOICE", "LIBRARIES", "Analysis", "NotPositiveDefinite", "default_library"]

CHOICE = "WARPFACTOR_FACTORIZATION"  # environment: one of ON_CPU
ON_CPU = ("cholmod", "supernodal")
LIBRARIES = ("auto", *ON_CPU, "gpu", "gpu-float32", "gpu-float64")


class Library(Protocol):
    """Makes the factors: CholmodFactorization, SupernodalFactorization or GpuFactorization."""

    name: str
    pattern: FactorPattern

    def factorize(
        self, matrix: Float64, dtype: np.dtype[np.floating], out: NDArray[np.floating] | None
    ) -> NDArray[np.floating]: ...

    def modified_ldl(
        self, matrix: Float64, dtype: np.dtype[np.floating], growth: float
    ) -> tuple[NDArray[np.floating], int]: ...


@runtime_checkable
class ManyLibrary(Protocol):
    """A library that factorizes up to `most` matrices in one call, of which `together` take hardly more time than one:
    SupernodalFactorization, GpuFactorization."""

    most: int
    together: int

    def begin_many(self, matrices: Matrices, dtype: np.dtype[np.floating]) -> Begun | None: ...


@runtime_checkable
class DeviceLibrary(Protocol):
    """A library of a device, whose first matrix would wait for memory, and which factorizes what is there:
    GpuFactorization."""

    def make_ready(self, dtype: np.dtype[Any]) -> None: ...

    def factorize_on_device(
        self, matrix: int, dtype: np.dtype[np.floating], diagonal_blocks: Int64, threshold: float
    ) -> Callable[[int], None] | None: ...


class Analysis:
    """Factors of matrices with one block pattern.

    pattern: supernodal pattern of L, the same for every matrix and (given the same METIS) every machine; one for
        the libraries of the CPU and another, with larger supernodes, for GPUs
    library: "cholmod 3.0.14", "supernodal" or the name of the GPU with the precision used, "NVIDIA H200, float64"

    The matrix is taken to be symmetric: of mirrored entries one is read (permuted_csc.lower_triangle). Not for use by
    several threads at once. The BLAS may start threads: results repeat with OPENBLAS_NUM_THREADS=1, else they may
    differ in the last digits from run to run.
    """

    def __init__(self, row_start: ArrayLike, columns: ArrayLike, library: str = "auto"):
        """row_start (nodes + 1,), columns (blocks,): block rows, both triangles, columns ascending.

        library: one of LIBRARIES; auto: native code of our own, supernodal. Raises ValueError
        for a malformed pattern, ImportError if the library is not installed, errors.DeviceUnusable without a GPU,
        sim_server.backends.compiler.CompileError without a C++ compiler for supernodal.
        """
        start, column = checked_pattern(row_start, columns)
        self._blocks = len(column)
        self._library = open_library(library, start, column)
        self.library, self.pattern = self._library.name, self._library.pattern
        self._many = self._library if isinstance(self._library, ManyLibrary) else None

    def factorize(
        self, values: ArrayLike, dtype: DTypeLike = np.float32, out: NDArray[np.floating] | None = None
    ) -> NDArray[np.floating]:
        """Returns the values of L in the order of the pattern, (pattern.nonzeros,), float32 or float64.

        values: float64 (blocks, 3, 3). out: array to write to, of which the type is taken. Arithmetic is in float64,
        but for L in float32 by supernodal, and on GPUs that are slow at float64; the same values give the same factor,
        bit by bit. Raises ValueError for values of another shape or not finite, NotPositiveDefinite, MemoryError; the
        object stays usable.
        """
        matrix = np.ascontiguousarray(values, np.float64)
        if matrix.shape != (self._blocks, BLOCK, BLOCK):
            raise ValueError(f"matrix: values of shape {matrix.shape}, allowed: ({self._blocks}, {BLOCK}, {BLOCK})")
        kind: np.dtype[Any] = np.dtype(dtype) if out is None else out.dtype
        if kind not in (np.float32, np.float64):
            raise ValueError(f"factor: dtype {kind}, allowed: float32, float64")
        if out is not None and out.shape != (self.pattern.nonzeros,):
            raise ValueError(f"factor: out of shape {out.shape}, allowed: ({self.pattern.nonzeros},)")
        try:
            return self._library.factorize(matrix, kind, out)
        except NotPositiveDefinite as error:
            raise type(error)(self._where(error), error.column) from None

    def factorize_on_device(
        self, matrix: int, dtype: DTypeLike, diagonal_blocks: Int64, threshold: float
    ) -> Callable[[int], None] | None:
        """Factorizes a matrix at an address of device memory; returns what copies L to one. None: it must be factorized
        on the host. diagonal_blocks, threshold: GpuFactorization.factorize_on_device"""
        if not isinstance(self._library, DeviceLibrary):
            return None
        kind: np.dtype[Any] = np.dtype(dtype)
        return self._library.factorize_on_device(matrix, kind, diagonal_blocks, threshold)

    def make_ready(self, dtype: DTypeLike = np.float32) -> None:
        """Does before the first matrix what it would wait for: on a GPU memory is taken and the launches are made.

        dtype: of the factors that will be asked for. Raises MemoryError, DeviceUnusable.
        """
        if isinstance(self._library, DeviceLibrary):
            self._library.make_ready(np.dtype(dtype))

    @property
    def most(self) -> int:
        """Number of matrices that are factorized in one call."""
        return 1 if self._many is None else self._many.most

    @property
    def together(self) -> int:
        """Number of matrices that take hardly more time than one, factorized in one call."""
        return 1 if self._many is None else self._many.together

    def begin_many(self, matrices: Matrices, dtype: DTypeLike = np.float32) -> Begun | None:
        """Begins to factorize up to `most` matrices together, and may return before it is done; None if they must be
        factorized one by one. Raises Refused for matrices that are found to be spoilt."""
        if self._many is None or matrices.blocks != self._blocks:
            return None
        kind: np.dtype[Any] = np.dtype(dtype)
        return self._many.begin_many(matrices, kind)

    def modified_ldl(self, matrix: Float64, dtype: DTypeLike, growth: float) -> tuple[NDArray[np.floating], int]:
        """Returns the values of L |D|^1/2 of a matrix that is not positive definite, and the number of negative pivots.

        Raises NotPositiveDefinite if there is no such factor, or it is more than `growth` times the matrix.
        """
        kind: np.dtype[Any] = np.dtype(dtype)
        return self._library.modified_ldl(matrix, kind, growth)

    def _where(self, error: NotPositiveDefinite) -> str:
        if error.column < 0:
            return f"matrix: not positive definite ({error})"
        node, axis = divmod(int(self.pattern.permutation[error.column]), BLOCK)
        return f"matrix: not positive definite ({error} at node {node}, axis {'xyz'[axis]})"


def open_library(library: str, row_start: Int32, columns: Int32) -> Library:
    """Returns the library for a checked pattern."""
    if library not in LIBRARIES:
        raise ValueError(f"factorization library {library!r}, allowed: {', '.join(LIBRARIES)}")
    if library.startswith("gpu"):
        from precond_worker.gpu.gpu_factorization import GpuFactorization

        return GpuFactorization(row_start, columns, library.removeprefix("gpu").removeprefix("-") or "auto")
    chosen = default_library() if library == "auto" else library
    if chosen == "cholmod":
        from precond_worker.factorization.cholmod import CholmodFactorization

        return CholmodFactorization(row_start, columns)
    from precond_worker.factorization.supernodal import SupernodalFactorization

    return SupernodalFactorization(row_start, columns)


def default_library() -> str:
    """Returns what "auto" stands for on a CPU: supernodal.

    It takes less time than CHOLMOD at every size that was measured (docs/bench/factors.md), and steps take as many
    iterations. The environment variable WARPFACTOR_FACTORIZATION forces one of ON_CPU; raises ValueError if it names
    another.
    """
    forced = os.environ.get(CHOICE, "")
    if forced not in ("", *ON_CPU):
        raise ValueError(f"{CHOICE}={forced}, allowed: {', '.join(ON_CPU)}")
    return forced or "supernodal"
