# SPDX-License-Identifier: MIT
"""A plan on the device: its tables and memory, and all launches of a factorization as one CUDA graph."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from precond_worker.arrays import Float64, Int32
from precond_worker.errors import DeviceUnusable
from precond_worker.gpu.device import cupy, kernels
from precond_worker.gpu.plan import MultifrontalPlan
from precond_worker.gpu.tables import KernelLaunch, front_table, launch_list
from precond_worker.many import Matrices

THREADS = {"assemble": 192, "store": 192}  # per block; 128 in the other kernels (multifrontal.cu)
NONE = np.iinfo(np.int32).max
GIB = 2**30


class Outcome(NamedTuple):
    """First columns of L that failed (-1: none), and whether the matrix held NaN or infinity."""

    pivot: int
    range: int
    infinite: bool


class Executor:
    """Factorizes matrices of one plan in memory of its own.

    precision, stored: "float32" or "float64", of the fronts and of L
    copies: number of matrices of one pattern that the plan is of (copies.py)

    Raises MemoryError, with the number of bytes, if the device has too little memory.
    """

    def __init__(self, plan: MultifrontalPlan, precision: str, stored: str, copies: int = 1):
        self._copies, self._full = copies, copies == 1
        self._cp, self.plan, self.precision = cupy(), plan, precision
        self._kernels = kernels(precision, stored)
        self._stored = np.dtype(stored)
        self._list, starts = launch_list(plan)
        self._reserve(starts)
        self.stream = self._cp.cuda.Stream(non_blocking=True)
        self._running: tuple[NDArray[Any], ...] = ()
        with self.stream:
            self.stream.begin_capture()
            try:
                self._launch_all()
            finally:
                self._graph = self.stream.end_capture()
        self._cp.cuda.Device().synchronize()  # the tables were sent on another stream

    @property
    def bytes(self) -> int:
        """Device memory of the large arrays, in bytes."""
        fronts = sum(self.plan.half) * np.dtype(self.precision).itemsize
        return fronts + self.plan.nonzeros * self._stored.itemsize + 72 * self.plan.blocks

    def _reserve(self, starts: Int32) -> None:
        cp, plan = self._cp, self.plan
        memory = cp.get_default_memory_pool()
        free, total = cp.cuda.runtime.memGetInfo()
        free += memory.free_bytes()
        sizes = f"this object needs {self.bytes / GIB:.2f} GiB, {free / GIB:.2f} of {total / GIB:.1f} GiB are free"
        if self.bytes > free:
            raise MemoryError(f"GPU memory: {sizes}")
        try:
            self._halves = [cp.empty(max(size, 1), self.precision) for size in plan.half]
            self._values = cp.empty(plan.nonzeros, self._stored)
            self._blocks = cp.empty(9 * plan.blocks, np.float64)
            self._status = cp.zeros(3, np.int32)
            self._tables = {
                "fronts": cp.asarray(front_table(plan).view(np.uint8)),
                "starts": cp.asarray(starts),
                "child": cp.asarray(plan.child.astype(np.int32)),
                "map": cp.asarray(plan.map),
                "split": cp.asarray(plan.split),
                "entry_start": cp.asarray(plan.entry_start),
                "entry_block": cp.asarray(plan.entry_block),
                "entry_row": cp.asarray(plan.entry_row),
            }
            sent = self._pinned(9 * plan.blocks, np.dtype(np.float64))
            self.sent: Float64 = sent.reshape(self._copies, -1)  # matrices of the last `begin`, until the next one
        except (cp.cuda.memory.OutOfMemoryError, cp.cuda.runtime.CUDARuntimeError) as error:
            self.__dict__.clear()
            memory.free_all_blocks()
            raise MemoryError(f"GPU memory: {sizes} ({error})") from error

    def _pinned(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Allocates an array in page-locked memory of CuPy's pool, to which it returns when dropped."""
        memory = self._cp.cuda.alloc_pinned_memory(max(count * dtype.itemsize, 1))
        return np.frombuffer(memory, dtype, count)

    def _launch_all(self) -> None:
        status = self._status
        count = np.int64(self._blocks.size)
        self._kernels["reset"]((1,), (1,), (status,))
        blocks = max(1, min(1024, self._blocks.size // 1024))
        self._kernels["check_finite"]((blocks,), (256,), (self._blocks, count, status))
        for launch in self._list:
            threads = THREADS.get(launch.kernel, 128)
            self._kernels[launch.kernel]((launch.blocks,), (threads,), self._arguments(launch))

    def _arguments(self, launch: KernelLaunch) -> tuple[Any, ...]:
        tables, status = self._tables, self._status
        here, there = self._halves[launch.level % 2], self._halves[1 - launch.level % 2]
        fronts = np.uint64(tables["fronts"].data.ptr + 64 * int(self.plan.level_start[launch.level]))
        start = np.uint64(tables["starts"].data.ptr + 4 * launch.table)
        step, count = np.int32(launch.step), np.int32(launch.fronts)
        if launch.kernel == "assemble":
            lists = [tables[name] for name in ("fronts", "child", "map", "split")]
            entries = [tables[name] for name in ("entry_start", "entry_block", "entry_row")]
            return (fronts, start, count, *lists, *entries, self._blocks, here, there)
        return {
            "factor": (fronts, here, status),
            "panel": (fronts, start, count, step, here),
            "update": (fronts, start, count, step, here, status),
            "store": (fronts, start, count, here, self._values, status),
        }[launch.kernel]

    def run(self, matrices: Matrices) -> tuple[NDArray[Any], Outcome]:
        """Returns the values of L of each, (len(matrices), nonzeros), of block values (blocks, 3, 3), in an array of
        their own. Columns of L in the outcome are counted through all of them.

        matrices: one up to as many as the plan is of
        Raises DeviceUnusable if the device fails; this process cannot use it any more.
        """
        return self.begin(matrices)()

    def begin(self, matrices: Matrices) -> Callable[[], tuple[NDArray[Any], Outcome]]:
        """Begins to factorize matrices; what is returned waits for it and returns what `run` does. Raises as `run`, and
        what `matrices` raise.

        Waits for what this executor began before.
        """
        asked = len(matrices)
        count = asked if self._full else self._copies
        values = self._pinned(asked * self.plan.nonzeros // self._copies, self._stored)
        outcome = self._pinned(3, np.dtype(np.int32))
        with self._usable():
            self.stream.synchronize()
            matrices.copy_to(self.sent[:asked])
            self.sent[asked:count] = self.sent[asked - 1]  # at first, and after a failure, all places are taken
            self._running = values, outcome  # the device writes to them, whatever becomes of what is returned
            self._copy(self._blocks.data.ptr, self.sent.ctypes.data, self.sent[:count].nbytes)
            self._graph.launch(self.stream)
            self._copy(outcome.ctypes.data, self._status.data.ptr, outcome.nbytes)
            self._copy(values.ctypes.data, self._values.data.ptr, values.nbytes)
        self._full = self._copies == 1  # until it is known that none failed
        return partial(self._end, values.reshape(asked, -1), outcome)

    def run_on_device(self, matrix: int) -> Outcome:
        """Factorizes a matrix that is on the device, as `run`; L stays there (`pivots_are_sound`, `copy_values`).

        matrix: address of the values, float64 (blocks, 3, 3), which nobody changes meanwhile
        """
        outcome = self._pinned(3, np.dtype(np.int32))
        with self._usable():
            self.stream.synchronize()
            self._copy(self._blocks.data.ptr, matrix, self._blocks.nbytes)
            self._graph.launch(self.stream)
            self._copy(outcome.ctypes.data, self._status.data.ptr, outcome.nbytes)
        return self._end(outcome, outcome)[1]

    def pivots_are_sound(self, diagonal: Any, block: Any, threshold: float) -> bool:
        """True if every pivot of the last factor is more than rounding error.

        diagonal, block: on the device, as `check_pivots` in multifrontal.cu has them
        threshold: of the square of a pivot over the largest diagonal entry of its node
        """
        with self._usable():
            unsound = self._cp.zeros(1, np.int32)
            self._cp.cuda.get_current_stream().synchronize()
            with self.stream:
                size = len(diagonal)
                self._kernels["check_pivots"](
                    (min(-(-size // 256), 264),), (256,),
                    (self._values, diagonal, block, np.int32(size), self._blocks, np.float64(threshold), unsound),
                )  # fmt: skip
                return not unsound.get(stream=self.stream)[0]

    def copy_values(self, to: int) -> None:
        """Copies L of the matrix factorized last to an address; it is there when this returns."""
        with self._usable():
            self._copy(to, self._values.data.ptr, self._values.nbytes)
            self.stream.synchronize()

    def _end(self, values: NDArray[Any], found: NDArray[np.int32]) -> tuple[NDArray[Any], Outcome]:
        with self._usable():
            self.stream.synchronize()
        pivot, range_, infinite = (-1 if c == NONE else int(c) for c in found)
        outcome = Outcome(pivot, range_, bool(infinite))
        self._full = self._copies == 1 or outcome == Outcome(-1, -1, False)
        return values, outcome

    @contextmanager
    def _usable(self) -> Iterator[None]:
        try:
            yield
        except self._cp.cuda.runtime.CUDARuntimeError as error:
            raise DeviceUnusable(f"the GPU failed: {error}") from error

    def _copy(self, to: int, source: int, size: int) -> None:
        self._cp.cuda.runtime.memcpyAsync(to, source, size, self._cp.cuda.runtime.memcpyDefault, self.stream.ptr)
