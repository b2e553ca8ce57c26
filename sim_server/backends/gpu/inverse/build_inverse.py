# SPDX-License-Identifier: MIT
"""Builds the partitioned inverse (plan.py) from the values of L on the device, beside the running steps.

A build is a copy or two from pinned memory and one launch of a graph of the kernels in build_inverse.cu. Memory is
allocated only when an InverseBuilder or an InverseStorage is made.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.gpu.cupy_types import DeviceArray, Event, Graph, KernelFunction
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.inverse.apply_inverse import Applied, InverseApplication, application_kernels
from sim_server.backends.gpu.inverse.expansion_batches import EDGE, BuildBatch, workspace_layout
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS
from sim_server.backends.gpu.inverse.plan import Plan
from sim_server.backends.gpu.inverse.workspace import workspace
from sim_server.backends.gpu.pinned import PinnedArray

HEAD = 16  # bytes in front of the values: the two addresses of a storage
Groups = tuple[int, int, int, int]
"""Of a kernel: threads and bytes of shared memory of a group of threads, groups in a small and in a large block."""
TILES: Groups = (128, 4 * (EDGE * (EDGE + 1) + 2 * EDGE), 1, 5)
KERNELS: dict[str, Groups] = {
    "scatter": (32, 0, 8, 32),
    "invert": (64, 4 * EDGE * (EDGE + 1), 1, 4),
    "couple": TILES,
    "merge": TILES,
    "lengths": (256, 4 * 256, 1, 4),
    "finish": TILES,
}


def builder_kernels(gpu: Gpu) -> dict[str, KernelFunction]:
    """Returns the kernels of build_inverse.cu by name, compiled, as is what applies inverses. Raises CompileError."""
    application_kernels(gpu)
    return {name: gpu.module("backends/gpu/inverse/build_inverse.cu").function(name) for name in KERNELS}


class PartitionedInverse(NamedTuple):
    """The inverse of a factor on the device.

    matrix: address of the chunks, float16
    scale: address of d in packed order, float32 (N + 1,): 0 in padding, then the largest d
    event: after it both are complete
    """

    matrix: int
    scale: int
    event: Event


class InverseStorage(NamedTuple):
    """Device memory for one inverse. matrix: (chunks, 8, 32) float16. scale: (N + 1,) float32."""

    matrix: DeviceArray
    scale: DeviceArray


class InverseBuilder:
    """Builds the inverses of factors with one pattern by one plan, for any number of bodies."""

    def __init__(self, gpu: Gpu, pattern: FactorPattern, plan: Plan):
        cp = gpu.cp
        self.plan, self._gpu, self._nonzeros = plan, gpu, pattern.nonzeros
        self._layout = layout = workspace_layout(pattern, plan)
        tables = (layout.parts, layout.columns)
        self._parts, self._columns = (cp.asarray(t.view(np.uint8)) for t in tables)
        self._place, self._boundary = cp.asarray(layout.place), cp.asarray(plan.boundary)
        self._row_chunk, self._out_chunk = cp.asarray(layout.row_chunk), cp.asarray(layout.out_chunk)
        self._tasks = [[cp.asarray(t) for t in (b.diagonal, b.finish, *b.merges)] for b in layout.batches]
        self._workspace = workspace(cp.cuda.Device().id)
        self._workspace.reserve(layout.size, HEAD + 4 * self._nonzeros)
        self._functions = builder_kernels(gpu)
        self._application: InverseApplication | None = None
        self._graphs: dict[int | None, Graph] = {}
        self._generation = -1
        cp.cuda.get_current_stream().synchronize()  # the tables are there for the stream of builds, which does not wait

    def storage(self) -> InverseStorage:
        """Allocates memory for one inverse, set to zero."""
        cp, p = self._gpu.cp, self.plan
        made = InverseStorage(cp.zeros((p.chunks, ROWS, COLUMNS), np.float16), cp.zeros(p.size + 1, np.float32))
        cp.cuda.get_current_stream().synchronize()  # zero before a build writes, in its own stream
        return made

    def build(
        self, values: NDArray[np.floating], storage: InverseStorage, multiprocessors: int | None = None
    ) -> PartitionedInverse:
        """Begins to build the inverse for the values (nonzeros,) of L; returns before it is complete.

        Waits until the values of the build before have been copied to the device.

        storage: memory that nothing under way reads
        multiprocessors: largest number that the build keeps busy, for whole milliseconds; a launch that needs only the
            others runs beside it. None: all of them; a launch that needs all then waits some 100 us now and then.
        """
        with self._workspace.lock:
            return self._begin(values, storage, multiprocessors)

    def apply(self, inverse: PartitionedInverse, r: Float64, multiprocessors: int | None = None) -> Applied:
        """Begins to apply an inverse that a build under way makes to r (n,); returns before it is complete."""
        with self._workspace.lock:
            if self._application is None:
                self._application = InverseApplication(self._gpu, self.plan)
            most = multiprocessors or self._gpu.properties["multiProcessorCount"]
            return self._application.begin(inverse.matrix, inverse.scale, r, self._workspace.stream, most)

    def _begin(
        self, values: NDArray[np.floating], storage: InverseStorage, multiprocessors: int | None
    ) -> PartitionedInverse:  # fmt: skip
        space, cp = self._workspace, self._gpu.cp
        if space.copied is not None:
            space.copied.synchronize()
        size = HEAD + 4 * self._nonzeros
        addresses = storage.matrix.data.ptr, storage.scale.data.ptr
        space.staging[:HEAD].view(np.uint64)[:] = addresses
        graph, stream = self._graph(multiprocessors), space.stream
        at, copy, kind = int(space.incoming.data.ptr), cp.cuda.runtime.memcpyAsync, cp.cuda.runtime.memcpyHostToDevice
        if isinstance(values, PinnedArray) and values.dtype == np.float32 and values.flags.c_contiguous:
            copy(at, space.staging.ctypes.data, HEAD, kind, stream.ptr)
            copy(at + HEAD, values.ctypes.data, size - HEAD, kind, stream.ptr)
        else:
            space.staging[HEAD:size].view(np.float32)[:] = values
            copy(at, space.staging.ctypes.data, size, kind, stream.ptr)
        space.copied, space.source = stream.record(), values
        graph.launch(stream)
        return PartitionedInverse(*addresses, stream.record())

    def _graph(self, limit: int | None) -> Graph:
        """Returns the graph of a build that keeps at most `limit` multiprocessors busy."""
        if self._generation != self._workspace.generation:  # graphs hold its addresses
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
        """Launches the kernels that build the parts of a batch."""
        space, parts, last = self._workspace, self._parts, np.int32(self.plan.size)
        memory, target = (np.uint64(a.data.ptr) for a in (space.memory, space.incoming))
        diagonal, finish, *merges = self._tasks[number]

        def launch(name: str, tasks: DeviceArray, *more: Any) -> None:
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
