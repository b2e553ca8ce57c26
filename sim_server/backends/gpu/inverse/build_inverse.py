# SPDX-License-Identifier: MIT
"""From the values of L to what the GPU applies (plan.py), on the device, beside the running steps.

Per expansion: one copy from pinned memory and one launch of a graph of the kernels in build_inverse.cu. No memory is
allocated but when an InverseBuilder is made.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.inverse.expansion_batches import EDGE, BuildBatch, layout
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS
from sim_server.backends.gpu.inverse.plan import Plan
from sim_server.backends.gpu.inverse.workspace import workspace

HEAD = 16  # bytes in front of the values: the two addresses of a target
# Of a kernel: threads and bytes of shared memory of a group, groups in a small and in a large block.
Groups = tuple[int, int, int, int]
TILES: Groups = (128, 4 * (EDGE * (EDGE + 1) + 2 * EDGE), 1, 5)
KERNELS: dict[str, Groups] = {
    "scatter": (32, 0, 8, 32),
    "invert": (64, 4 * EDGE * (EDGE + 1), 1, 4),
    "couple": TILES,
    "merge": TILES,
    "lengths": (256, 4 * 256, 1, 4),
    "finish": TILES,
}


class PartitionedInverse(NamedTuple):
    """Device addresses of the chunks (float16) and of the scale (float32, (N + 1,): d in packed order, 0 in padding,
    then the largest d); the event after which they hold."""

    matrix: int
    scale: int
    event: Any


class InverseStorage(NamedTuple):
    """Memory for one expanded factor: chunks (chunks, 8, 32) float16, scale (N + 1,) float32."""

    matrix: Any
    scale: Any


class InverseBuilder:
    """Of factors with one pattern by one plan, for any number of bodies."""

    def __init__(self, gpu: Gpu, pattern: FactorPattern, plan: Plan):
        cp = gpu.cp
        self.plan, self._gpu, self._nonzeros = plan, gpu, pattern.nonzeros
        self._layout = made = layout(pattern, plan)
        tables = (made.parts, made.columns)
        self._parts, self._columns = (cp.asarray(t.view(np.uint8)) for t in tables)
        self._place, self._boundary = cp.asarray(made.place), cp.asarray(plan.boundary)
        self._row_chunk, self._out_chunk = cp.asarray(made.row_chunk), cp.asarray(made.out_chunk)
        self._tasks = [[cp.asarray(t) for t in (b.diagonal, b.finish, *b.merges)] for b in made.batches]
        self._workspace = workspace(cp.cuda.Device().id)
        self._workspace.reserve(made.room, HEAD + 4 * self._nonzeros)
        self._functions = {name: gpu.module("backends/gpu/inverse/build_inverse.cu").function(name) for name in KERNELS}
        self._graphs: dict[int | None, Any] = {}
        self._generation = -1

    def target(self) -> InverseStorage:
        """New memory for one factor, all zeros."""
        cp, p = self._gpu.cp, self.plan
        return InverseStorage(cp.zeros((p.chunks, ROWS, COLUMNS), np.float16), cp.zeros(p.size + 1, np.float32))

    def expand(
        self, values: NDArray[Any], target: InverseStorage, multiprocessors: int | None = None
    ) -> PartitionedInverse:
        """Starts making what `values` (nonzeros,) stand for. Nobody may be using the target; returns at once, but
        waits for the values of an expansion before it to have been copied to the device. For one thread at a time.

        multiprocessors: at most so many are kept busy, for whole milliseconds; a launch that needs all the others
        runs beside. None: all of them, and a launch that needs all waits some 100 us now and then.
        """
        space, cp = self._workspace, self._gpu.cp
        if space.copied is not None:
            space.copied.synchronize()
        size = HEAD + 4 * self._nonzeros
        addresses = target.matrix.data.ptr, target.scale.data.ptr
        space.staging[:HEAD].view(np.uint64)[:] = addresses
        space.staging[HEAD:size].view(np.float32)[:] = values
        graph, stream = self._graph(multiprocessors), space.stream
        cp.cuda.runtime.memcpyAsync(
            space.incoming.data.ptr, space.staging.ctypes.data, size, cp.cuda.runtime.memcpyHostToDevice, stream.ptr
        )
        space.copied = stream.record()
        graph.launch(stream)
        return PartitionedInverse(*addresses, stream.record())

    def _graph(self, limit: int | None) -> Any:
        if self._generation != self._workspace.generation:  # they hold its addresses
            self._graphs, self._generation = {}, self._workspace.generation
        if limit not in self._graphs:
            stream = self._workspace.stream
            with stream:
                stream.begin_capture()
                try:
                    for number, batch in enumerate(self._layout.batches):
                        self._batch(number, batch, limit)
                finally:
                    graph = stream.end_capture()
                self._graphs[limit] = graph
        return self._graphs[limit]

    def _batch(self, number: int, batch: BuildBatch, limit: int | None) -> None:
        space, parts, last = self._workspace, self._parts, np.int32(self.plan.size)
        memory, target = (np.uint64(a.data.ptr) for a in (space.memory, space.incoming))
        diagonal, finish, *merges = self._tasks[number]

        def launch(name: str, tasks: Any, *more: Any) -> None:
            self._launch(name, limit, len(tasks), parts, tasks, np.int32(len(tasks)), memory, *more)

        self._gpu.cp.cuda.runtime.memsetAsync(int(memory), 0, batch.cleared, space.stream.ptr)
        self._launch(
            "scatter", limit, batch.last - batch.first, parts, self._columns, np.int32(batch.first),
            np.int32(batch.last), self._place, np.uint64(target + HEAD), memory, np.int32(number == 0), last, target,
        )  # fmt: skip
        launch("invert", diagonal)
        for tasks in merges:
            launch("couple", tasks)
            launch("merge", tasks)
        launch("lengths", diagonal, last, target)
        tables = (self._boundary, self._row_chunk, self._out_chunk)
        launch("finish", finish, *tables, np.int32(self.plan.planes), target)

    def _launch(self, name: str, limit: int | None, tasks: int, *arguments: Any) -> None:
        if tasks == 0:
            return
        threads, shared, small, large = KERNELS[name]
        room = self._gpu.properties["sharedMemPerBlockOptin"] // max(1, shared)
        groups = min(large, room) if limit else small
        blocks = min(-(-tasks // groups), limit or tasks)
        function = self._functions[name]
        if groups * shared > 48 << 10:
            function.max_dynamic_shared_size_bytes = groups * shared
        function((blocks,), (groups * threads,), arguments, shared_mem=groups * shared)
