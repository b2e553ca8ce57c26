# SPDX-License-Identifier: MIT
"""From the values of L to what the GPU applies (plan.py), on the device, beside the running steps.

Per expansion: one copy from pinned memory and one launch of a graph of the kernels in expansion.cu. No memory is
allocated but when an Expansion is made.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.gpu.batches import Batch, layout
from sim_server.gpu.device import Gpu
from sim_server.gpu.partition import COLUMNS, ROWS
from sim_server.gpu.plan import Plan
from sim_server.gpu.workspace import workspace

BUFFERS = 3  # per body: in use, waiting to be taken up, being made
HEAD = 16  # bytes in front of the values: the two addresses of a target
THREADS, EDGE = 256, 64


class Expanded(NamedTuple):
    """Device addresses of the chunks (float16) and of the scale (float32, (N + 1,): d in packed order, 0 in padding,
    then the largest d); the event after which they hold."""

    matrix: int
    scale: int
    event: Any


class Target(NamedTuple):
    """Memory for one expanded factor: chunks (chunks, 8, 32) float16, scale (N + 1,) float32."""

    matrix: Any
    scale: Any


class Expansion:
    """Of factors with one pattern by one plan, for any number of bodies.

    multiprocessors: how many may be busy with it at a time; None: all of them, with short thread blocks.
    """

    def __init__(self, gpu: Gpu, pattern: FactorPattern, plan: Plan, multiprocessors: int | None = None):
        cp = gpu.cp
        self.plan, self._gpu, self._limit = plan, gpu, multiprocessors
        self._nonzeros = pattern.nonzeros
        self._layout = made = layout(pattern, plan)
        tables = (made.parts, made.columns)
        self._parts, self._columns = (cp.asarray(t.view(np.uint8)) for t in tables)
        self._place, self._boundary = cp.asarray(made.place), cp.asarray(plan.boundary)
        self._row_chunk, self._out_chunk = cp.asarray(made.row_chunk), cp.asarray(made.out_chunk)
        self._tasks = [[cp.asarray(t) for t in (b.diagonal, b.finish, *b.merges)] for b in made.batches]
        self._workspace = workspace(cp.cuda.Device().id)
        self._workspace.reserve(made.room, HEAD + 4 * self._nonzeros)
        self._graph: Any = None
        self._generation = -1

    def target(self) -> Target:
        """New memory for one factor, all zeros."""
        cp, p = self._gpu.cp, self.plan
        return Target(cp.zeros((p.chunks, ROWS, COLUMNS), np.float16), cp.zeros(p.size + 1, np.float32))

    def expand(self, values: NDArray[Any], target: Target) -> Expanded:
        """Starts making what `values` (nonzeros,) stand for. Nobody may be using the target; returns at once, but
        waits for the values of an expansion before it to have been copied to the device."""
        space, cp = self._workspace, self._gpu.cp
        if space.copied is not None:
            space.copied.synchronize()
        size = HEAD + 4 * self._nonzeros
        addresses = target.matrix.data.ptr, target.scale.data.ptr
        space.staging[:HEAD].view(np.uint64)[:] = addresses
        space.staging[HEAD:size].view(np.float32)[:] = values
        if self._generation != space.generation:
            self._graph, self._generation = self._capture(), space.generation
        stream = space.stream
        cp.cuda.runtime.memcpyAsync(
            space.incoming.data.ptr, space.staging.ctypes.data, size, cp.cuda.runtime.memcpyHostToDevice, stream.ptr
        )
        space.copied = stream.record()
        self._graph.launch(stream)
        return Expanded(*addresses, stream.record())

    def _capture(self) -> Any:
        stream = self._workspace.stream
        with stream:
            stream.begin_capture()
            for batch, tasks in zip(self._layout.batches, self._tasks, strict=True):
                self._batch(batch, batch is self._layout.batches[0], *tasks)
            return stream.end_capture()

    def _batch(self, batch: Batch, begin: bool, diagonal: Any, finish: Any, *merges: Any) -> None:
        space, runtime, parts = self._workspace, self._gpu.cp.cuda.runtime, self._parts
        memory, target = np.uint64(space.memory.data.ptr), np.uint64(space.incoming.data.ptr)
        last = np.int32(self.plan.size)
        runtime.memsetAsync(space.memory.data.ptr, 0, batch.cleared, space.stream.ptr)
        first, end, columns = np.int32(batch.first), np.int32(batch.last), self._columns
        self._launch(
            "scatter", -(-(batch.last - batch.first) // (THREADS // 32)), THREADS,
            parts, columns, first, end, self._place, np.uint64(target + HEAD), memory, np.int32(begin), last, target,
        )  # fmt: skip
        self._launch("invert", len(diagonal), EDGE, parts, diagonal, np.int32(len(diagonal)), memory)
        for tasks in merges:
            self._launch("couple", len(tasks), THREADS, parts, tasks, np.int32(len(tasks)), memory)
            self._launch("merge", len(tasks), THREADS, parts, tasks, np.int32(len(tasks)), memory)
        count = np.int32(len(diagonal))
        self._launch("lengths", 2 * len(diagonal), THREADS, parts, diagonal, count, memory, last, target)
        self._launch(
            "finish", len(finish), THREADS, parts, finish, np.int32(len(finish)), memory, self._boundary,
            self._row_chunk, self._out_chunk, np.int32(self.plan.planes), target,
        )  # fmt: skip

    def _launch(self, name: str, blocks: int, threads: int, *arguments: Any) -> None:
        function = self._gpu.module("gpu/expansion.cu").function(name)
        shared = 0
        if self._limit:  # so much shared memory that a multiprocessor takes one thread block only
            blocks, shared = min(blocks, self._limit), self._gpu.properties["sharedMemPerMultiprocessor"] // 2
            function.max_dynamic_shared_size_bytes = shared
        if blocks:
            function((blocks,), (threads,), arguments, shared_mem=shared)
