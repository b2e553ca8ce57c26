# SPDX-License-Identifier: MIT
"""Sparse factors made block column by block column in native code (native/incomplete.cpp).

Each node is a supernode, so that these factors are sent and applied like complete ones; what is dropped from L saves
bytes and time.
"""

import contextlib
import ctypes as c
import weakref
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from precond_worker.arrays import Float64, Int32, Int64
from precond_worker.symbolic.blocks import BLOCK, degrees_of_freedom, inverse_permutation, rows_of
from protocol.factor import FactorPattern, pattern_id

SOURCE = Path(__file__).with_name("native") / "incomplete.cpp"


class _Lower(c.Structure):
    _fields_ = [
        ("nodes", c.c_int32), ("unused", c.c_int32), ("start", c.c_void_p), ("row", c.c_void_p), ("source", c.c_void_p),
    ]  # fmt: skip


@cache
def _library() -> c.CDLL:
    """Compiled at the first call; raises sim_server.backends.compiler.CompileError without a C++ compiler."""
    from sim_server.backends.compiler import build  # lazily: complete factors need no compiler

    library, p, lower = c.CDLL(str(build(SOURCE, stepping=False))), c.c_void_p, c.POINTER(_Lower)
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "ic_new": (p, []), "ic_delete": (None, [p]), "ic_blocks": (c.c_int64, [p]),
        "ic_factorize": (c.c_int32, [lower, p, c.c_double, c.c_double, c.c_double, c.c_double, p]),
        "ic_ssor": (c.c_int32, [lower, p, c.c_double, p]),
        "ic_pattern": (None, [p, p, p]), "ic_values": (None, [p, p]),
    }  # fmt: skip
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def compile_ahead() -> None:
    """Compiles before a server waits for the first factor. If that fails, the jobs that need the code say why."""
    try:
        from sim_server.backends.build_pool import CompileError
    except ImportError:  # the server is not installed here
        return
    with contextlib.suppress(CompileError):
        _library()


def banded_order(row_start: Int32, columns: Int32) -> Int64:
    """Returns the reverse Cuthill-McKee order of the nodes (George 1971).

    Of the orders tried it has the least fill for the same iterations: on the heterogeneous beam incomplete factors in a
    nested dissection order took 1.5 times the bytes.
    """
    nodes = len(row_start) - 1
    graph = csr_matrix((np.ones(len(columns), np.int8), columns, row_start), shape=(nodes, nodes))
    return np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)


class BlockColumns:
    """Sparse factors of matrices of one block pattern, the nodes eliminated in the given order."""

    def __init__(self, row_start: Int32, columns: Int32, order: Int64):
        self._order = order
        rank = inverse_permutation(order)
        rows, cols = rank[rows_of(row_start)], rank[columns]
        blocks = np.flatnonzero(rows >= cols)  # as in permuted_csc.lower_triangle
        blocks = blocks[np.lexsort((rows[blocks], cols[blocks]))]
        counts = np.bincount(cols[blocks], minlength=len(order))
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self._arrays = start, rows[blocks].astype(np.int32), blocks.astype(np.int32)
        self._lower = _Lower(len(order), 0, *(a.ctypes.data for a in self._arrays))
        self._native = _library()
        self._factor = self._native.ic_new()
        weakref.finalize(self, self._native.ic_delete, self._factor)
        self.pattern: FactorPattern | None = None  # of the last factor

    def incomplete(
        self, values: Float64, shift: float, drop_tolerance: float, fill: float, pivot_threshold: float
    ) -> int:
        """Factorizes with `shift` times the norm of each node (blocks.node_norms) added to its diagonal.

        values (blocks, 3, 3). fill: bound of the blocks of a column over the mean number in A; 0: none.
        pivot_threshold: least pivot of a node over its norm. Returns -1, or the node where it broke down.
        """
        found = self._native.ic_factorize(
            c.byref(self._lower), values.ctypes.data, shift, drop_tolerance, fill, pivot_threshold, self._factor
        )
        return int(self._order[found]) if found >= 0 else -1

    def ssor(self, values: Float64, omega: float) -> int:
        """Makes the factor of SSOR; returns -1, or the node whose diagonal block is not positive definite."""
        found = self._native.ic_ssor(c.byref(self._lower), values.ctypes.data, omega, self._factor)
        return int(self._order[found]) if found >= 0 else -1

    def values(self) -> Float64:
        """Returns the values of the last factor in the order of `pattern`, a new object only if the pattern changed."""
        nodes, blocks = len(self._order), int(self._native.ic_blocks(self._factor))
        start, rows = np.empty(nodes + 1, np.int64), np.empty(blocks, np.int32)
        self._native.ic_pattern(self._factor, start.ctypes.data, rows.ctypes.data)
        self._renew_pattern(start, rows)
        values = np.empty(BLOCK * (BLOCK + 1) // 2 * nodes + BLOCK * BLOCK * blocks)
        self._native.ic_values(self._factor, values.ctypes.data)
        return values

    def _renew_pattern(self, start: Int64, rows: Int32) -> None:
        nodes = np.arange(len(self._order))
        whole = np.empty(len(rows) + len(nodes), np.int32)  # rows with the diagonal first
        own = start[:-1] + nodes
        below = np.ones(len(whole), bool)
        below[own] = False
        whole[own], whole[below] = nodes, rows
        arrays = (
            degrees_of_freedom(self._order).astype(np.int32),
            (BLOCK * np.arange(len(nodes) + 1)).astype(np.int32),
            BLOCK * (start + np.arange(len(nodes) + 1)),
            degrees_of_freedom(whole).astype(np.int32),
        )
        found = pattern_id(*arrays)
        if self.pattern is None or self.pattern.id != found:
            self.pattern = FactorPattern(found, *arrays)
