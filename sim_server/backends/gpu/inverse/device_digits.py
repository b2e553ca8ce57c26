# SPDX-License-Identifier: MIT
"""The estimate of digits.py for large factors, on the device, by the same rule and the same random signs (digits.cu).

Whether it is made here or on the host goes by the size of the factor alone, wherever its values are, so that replays,
whose factors come from the host, decide alike to the bit.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from protocol.factor import FactorPattern
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import KernelFunction, Stream
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.inverse.digits import MOST_RESPONSE, planes_of
from sim_server.backends.gpu.pinned import pinned_array

DIGITS = Declarations("backends/gpu/inverse/digits.cu")
SUPERNODE, ROWS_OF_SUPERNODE = DIGITS.dtype("Supernode"), DIGITS.dtype("RowsOfSupernode")
PROBES, THREADS, ROWS = (DIGITS.constant(name) for name in ("PROBES", "THREADS", "ROWS"))
KERNELS = ("solve_probes", "square_rows", "find_largest")
LARGEST_THREADS = 256
LARGE = 1 << 20  # bytes of the values of a factor that is large
MOST_PATTERNS = 4  # whose tables are kept


def digits_kernels(gpu: Gpu) -> dict[str, KernelFunction]:
    """Returns the kernels of digits.cu by name, compiled. Raises CompileError."""
    module = gpu.module("backends/gpu/inverse/digits.cu")
    return {name: module.function(name) for name in KERNELS}


def supernode_table(pattern: FactorPattern) -> np.ndarray:
    """Returns the supernodes of a pattern as digits.cu reads them."""
    width, height = np.diff(pattern.super_start), np.diff(pattern.row_start)
    table = np.zeros(len(width), SUPERNODE)
    table["values"], table["rows"] = pattern.value_start, pattern.row_start[:-1]
    table["first"], table["width"], table["height"] = pattern.super_start[:-1], width, height
    owner = np.repeat(np.arange(len(width), dtype=np.int32), width)  # of each column
    below = np.flatnonzero(height > width)
    table["parent"] = -1
    table["parent"][below] = owner[pattern.rows[pattern.row_start[below] + width[below]]]
    return table


def tasks_of_rows(pattern: FactorPattern) -> np.ndarray:
    """Returns the rows of supernodes that thread blocks square together."""
    counts = -(-np.diff(pattern.row_start) // ROWS)
    tasks = np.zeros(int(counts.sum()), ROWS_OF_SUPERNODE)
    tasks["supernode"] = np.repeat(np.arange(len(counts)), counts)
    tasks["first"] = ROWS * (np.arange(len(tasks)) - np.repeat(np.cumsum(counts) - counts, counts))
    return tasks


def places_of_rows(pattern: FactorPattern) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the row lists have each row of L: starts (n + 1,), and the places in ascending order."""
    shape = len(pattern.row_start) - 1, pattern.size
    lists = csr_array((np.arange(len(pattern.rows), dtype=np.int32), pattern.rows, pattern.row_start), shape=shape)
    found = lists.tocsc()
    return found.indptr.astype(np.int32), found.data.astype(np.int32)


class DeviceDigits:
    """Estimates how much rounded inverses of the factors of one pattern spoil. For one thread at a time."""

    def __init__(self, gpu: Gpu, pattern: FactorPattern):
        cp, self._gpu, self._size = gpu.cp, gpu, pattern.size
        self._functions = digits_kernels(gpu)
        table, tasks = supernode_table(pattern), tasks_of_rows(pattern)
        self._count, self._tasks_count = len(table), len(tasks)
        self._supernodes, self._tasks = (cp.asarray(t.view(np.uint8)) for t in (table, tasks))
        self._rows = cp.asarray(pattern.rows)
        self._start, self._list = (cp.asarray(a) for a in places_of_rows(pattern))
        self._y = cp.zeros(PROBES * pattern.size, np.float32)
        self._squares = cp.zeros(len(pattern.rows), np.float32)
        self._state = cp.zeros(4 + len(table), np.int32)  # the result, then that of solve_probes
        self._found = pinned_array(cp, 1, np.dtype(np.float64))
        cp.cuda.get_current_stream().synchronize()

    def largest_response(self, values: DeviceValues, stream: Stream, multiprocessors: int) -> float:
        """Returns an estimate of the largest A_ii (A^-1)_ii of A = L L^T (digits.largest_responses), the same bits for
        the same L. Waits for the device.

        values: (nonzeros,) float32 of L
        multiprocessors: that it keeps busy at most
        """
        cp, address = self._gpu.cp, np.uint64(values.address)
        largest, state = (np.uint64(self._state.data.ptr + offset) for offset in (0, 8))
        with stream:
            cp.cuda.runtime.memsetAsync(self._state.data.ptr, 0, self._state.nbytes, stream.ptr)
            self._launch(
                "solve_probes", self._count, multiprocessors, THREADS, self._supernodes, np.int32(self._count),
                self._rows, address, self._y, state,
            )  # fmt: skip
            self._launch(
                "square_rows", self._tasks_count, 8 * multiprocessors, ROWS, self._tasks, np.int32(self._tasks_count),
                self._supernodes, address, self._squares,
            )  # fmt: skip
            self._launch(
                "find_largest", -(-self._size // LARGEST_THREADS), 4 * multiprocessors, LARGEST_THREADS,
                np.int32(self._size), self._start, self._list, self._squares, self._y, largest,
            )  # fmt: skip
            kind = cp.cuda.runtime.memcpyDeviceToHost
            cp.cuda.runtime.memcpyAsync(self._found.ctypes.data, self._state.data.ptr, 8, kind, stream.ptr)
            stream.record().synchronize()
        return float(self._found[0])

    def planes_for(self, values: DeviceValues, stream: Stream, multiprocessors: int) -> int:
        """Returns the float16 numbers per entry that the inverse of this factor needs (digits.planes_of)."""
        return 1 if self.largest_response(values, stream, multiprocessors) <= MOST_RESPONSE else 2

    def _launch(self, name: str, blocks: int, most: int, threads: int, *arguments: object) -> None:
        self._functions[name]((max(1, min(blocks, most)),), (threads,), arguments)


def is_large(values: NDArray[np.floating] | DeviceValues) -> bool:
    """True if the digits of the inverse of a factor are chosen by what is estimated on the device."""
    return isinstance(values, DeviceValues) or values.nbytes > LARGE


class LargeFactors:
    """Brings large factors to the device and chooses the digits of their inverses. For one thread."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._stream: Stream = gpu.cp.cuda.Stream(non_blocking=True, priority=0)  # beside builds, which need not wait
        self._known: dict[int, DeviceDigits] = {}  # by id of the pattern, the one used last at the end

    def expect(self, pattern: FactorPattern) -> None:
        """Makes the tables for factors of a pattern, if there is memory for them."""
        try:
            self._prepare(pattern)
        except Exception as error:
            if not no_memory_left(error):
                raise

    def _prepare(self, pattern: FactorPattern) -> DeviceDigits:
        """Returns what estimates for factors of a pattern: its tables are made at the first call."""
        found = self._known.pop(pattern.id, None) or DeviceDigits(self._gpu, pattern)
        self._known[pattern.id] = found
        while len(self._known) > MOST_PATTERNS:
            del self._known[next(iter(self._known))]
        return found

    def brought(self, values: NDArray[np.floating] | DeviceValues) -> NDArray[np.floating] | DeviceValues:
        """Returns values of L on the device; as they are if it has too little memory. Waits for the copy."""
        if isinstance(values, DeviceValues):
            return values
        cp, host = self._gpu.cp, np.ascontiguousarray(values, np.float32)
        try:
            there = DeviceValues(cp.empty(len(host), np.float32))
        except cp.cuda.memory.OutOfMemoryError:
            return values
        kind = cp.cuda.runtime.memcpyHostToDevice
        cp.cuda.runtime.memcpyAsync(there.address, host.ctypes.data, host.nbytes, kind, self._stream.ptr)
        self._stream.synchronize()
        return there

    def planes_for(self, pattern: FactorPattern, values: DeviceValues, multiprocessors: int | None) -> int:
        """Returns the float16 numbers per entry that the inverse of a factor needs; by the estimate of the host if the
        device has too little memory. Waits for the device.

        multiprocessors: that it keeps busy at most; None: all
        """
        most = multiprocessors or self._gpu.properties["multiProcessorCount"]
        try:
            return self._prepare(pattern).planes_for(values, self._stream, most)
        except Exception as error:
            if not no_memory_left(error):
                raise
            return int(planes_of([(pattern, np.asarray(values))])[0])
