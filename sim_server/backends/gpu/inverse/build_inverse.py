# SPDX-License-Identifier: MIT
"""Builds the partitioned inverse (plan.py) from the values of L on the device, beside the running steps.

A build, of one factor or of several, is a copy or two from pinned memory and one launch of a graph of the kernels in
build_inverse.cu. Memory is allocated only when an InverseBuilder or an InverseStorage is made.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from protocol.shared_memory.located import addresses
from sim_server.arrays import Float64
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.cuda import driver_functions
from sim_server.backends.gpu.cupy_types import DeviceArray, Event, Graph, KernelFunction
from sim_server.backends.gpu.device import Gpu, no_memory_left
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.helper import FarInverse, Helper
from sim_server.backends.gpu.inverse.apply_inverse import Applied, InverseApplication, application_kernels
from sim_server.backends.gpu.inverse.expansion_batches import (
    BUILDS,
    COLUMN,
    EDGE,
    INVERSE_STORAGE,
    MOST_BUILDS,
    STRIDES,
    WORKSPACE,
    BuildBatch,
    workspace_layout,
)
from sim_server.backends.gpu.inverse.partition import COLUMNS, ROWS
from sim_server.backends.gpu.inverse.plan import Plan
from sim_server.backends.gpu.inverse.workspace import workspace
from sim_server.backends.gpu.mailbox import library
from sim_server.backends.gpu.pinned import readable

FLOAT32 = np.dtype(np.float32)
ALIGNMENT = 64  # numbers; 256 bytes, as of what is allocated alone
HEAD = BUILDS.itemsize  # bytes in front of the values: struct Builds
COUNTS = (1, 4, 16, MOST_BUILDS)  # of inverses, for which graphs are made
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
    far: a second GPU's part (helper.py), None: one GPU has it alone
    """

    matrix: int
    scale: int
    event: Event
    far: FarInverse | None = None


class InverseStorage(NamedTuple):
    """Device memory for one inverse. matrix: (chunks, 8, 32) float16. scale: (N + 1,) float32. target: their addresses.
    far: of a second GPU."""

    matrix: DeviceArray
    scale: DeviceArray
    target: tuple[int, int]
    far: FarInverse | None = None

    @classmethod
    def of(cls, matrix: DeviceArray, scale: DeviceArray) -> "InverseStorage":
        """Returns a storage in these arrays."""
        return cls(matrix, scale, (int(matrix.data.ptr), int(scale.data.ptr)))


class InverseBuilder:
    """Builds the inverses of factors with one pattern by one plan, for any number of bodies.

    most: number that `build_many` takes at a time; smaller than the one given if the workspace would be too large
    helper: a second GPU that gets the part of the second half of the plan's thread blocks
    """

    def __init__(self, gpu: Gpu, pattern: FactorPattern, plan: Plan, most: int = 1, helper: Helper | None = None):
        cp, self._helper = gpu.cp, helper
        self.plan, self._gpu, self._nonzeros = plan, gpu, pattern.nonzeros
        self._layout = layout = workspace_layout(pattern, plan)
        tables = (layout.parts, layout.columns)
        self._parts, self._columns = (cp.asarray(t.view(np.uint8)) for t in tables)
        self._place, self._boundary = cp.asarray(layout.place), cp.asarray(plan.boundary)
        self._row_chunk, self._out_chunk = cp.asarray(layout.row_chunk), cp.asarray(layout.out_chunk)
        self._tasks = [[cp.asarray(t) for t in (b.diagonal, b.finish, *b.merges)] for b in layout.batches]
        self._workspace = workspace(cp.cuda.Device().id)
        self.most = self._reserve(max(1, min(most, MOST_BUILDS, WORKSPACE // layout.size)))
        self._functions = builder_kernels(gpu)
        self._application: InverseApplication | None = None
        self._graphs: dict[tuple[int | None, int], Graph] = {}
        self._generation = -1
        cp.cuda.get_current_stream().synchronize()  # the tables are there for the stream of builds, which does not wait

    def _reserve(self, most: int) -> int:
        """Has the workspace made for builds of several; returns how many, fewer if there is too little memory."""
        try:
            self._workspace.reserve(most * self._layout.size, HEAD + 4 * most * self._nonzeros)
        except Exception as error:
            if most == 1 or not no_memory_left(error):
                raise
            return self._reserve(1)
        return most

    def storage(self) -> InverseStorage:
        """Allocates memory for one inverse, set to zero."""
        cp, p = self._gpu.cp, self.plan
        made = InverseStorage.of(cp.zeros((p.chunks, ROWS, COLUMNS), np.float16), cp.zeros(p.size + 1, np.float32))
        cp.cuda.get_current_stream().synchronize()  # zero before a build writes, in its own stream
        return made._replace(far=self._helper.storage(p)) if self._helper else made

    def several_storages(self, count: int) -> list[InverseStorage]:
        """Allocates memory for several inverses at once, which is given up once none of them is used."""
        cp, p = self._gpu.cp, self.plan
        pitch = -(-(p.size + 1) // ALIGNMENT) * ALIGNMENT
        matrices = cp.zeros((count, p.chunks, ROWS, COLUMNS), np.float16)
        scales = cp.zeros((count, pitch), np.float32)[:, : p.size + 1]
        cp.cuda.get_current_stream().synchronize()
        made = [InverseStorage.of(matrix, scale) for matrix, scale in zip(matrices, scales, strict=True)]
        return [each._replace(far=self._helper.storage(p)) for each in made] if self._helper else made

    def build(
        self, values: NDArray[np.floating] | DeviceValues, storage: InverseStorage, multiprocessors: int | None = None
    ) -> PartitionedInverse:
        """Begins to build the inverse for the values (nonzeros,) of L; returns before it is complete.

        Waits until the values of the build before have been copied to the device.

        storage: memory that nothing under way reads
        multiprocessors: largest number that the build keeps busy, for whole milliseconds; a launch that needs only the
            others runs beside it. None: all of them; a launch that needs all then waits some 100 us now and then.
        """
        event = self.build_many([values], [storage], multiprocessors)
        return PartitionedInverse(*storage.target, event, storage.far)

    def build_many(
        self,
        values: Sequence[NDArray[np.floating] | DeviceValues],
        storages: Sequence[InverseStorage],
        multiprocessors: int | None,
    ) -> Event:  # fmt: skip
        """Begins to build the inverses of up to `most` factors in the same launches; otherwise as `build`. Returns the
        event after which all of them are complete.

        Each has the same bits as if it were built alone.
        """
        with self._workspace.lock:
            return self._begin(values, storages, multiprocessors)

    def apply(self, storage: InverseStorage, r: Float64, multiprocessors: int | None = None) -> Applied:
        """Begins to apply an inverse that a build under way makes in a storage to r (n,); returns before it is
        complete."""
        with self._workspace.lock:
            if self._application is None:
                self._application = InverseApplication(self._gpu, self.plan)
            most = multiprocessors or self._gpu.properties["multiProcessorCount"]
            return self._application.begin(*storage.target, r, self._workspace.stream, most)

    def _begin(
        self, values: Sequence[NDArray[np.floating] | DeviceValues], storages: Sequence[InverseStorage],
        multiprocessors: int | None,
    ) -> Event:  # fmt: skip
        space, cp, count, helped = self._workspace, self._gpu.cp, len(values), self._helper is not None
        assert 0 < count <= self.most and count == len(storages)
        head = np.zeros((), BUILDS)
        head["count"] = count
        targets = np.array([storage.target for storage in storages], np.uint64)
        head["targets"][:count] = targets.view(INVERSE_STORAGE).ravel()
        graph, stream = self._graph(multiprocessors, next(c for c in COUNTS if c >= count)), space.stream
        values, values_are = readable(values, FLOAT32)
        sources, done = addresses(values), cp.cuda.Event(disable_timing=True)
        launch = structs.BuildLaunch(
            stream=stream.ptr, copied=space.copied.ptr, done=0 if helped else done.ptr, graph=int(graph.graphExec),
            head=head.ctypes.data, head_bytes=HEAD, staging=space.staging.ctypes.data,
            incoming=int(space.incoming.data.ptr), sources=sources.ctypes.data, count=count,
            bytes=4 * self._nonzeros, values_are=values_are,
        )  # fmt: skip
        error = library().wf_launch_build(driver_functions(), launch)
        space.source = list(values)
        if error:
            raise cp.cuda.runtime.CUDARuntimeError(error)
        if self._helper:
            for each in storages:
                if each.far:
                    self._helper.copy(each.far, each.matrix, each.scale, stream)
            done.record(stream)
        return cast(Event, done)

    def _graph(self, limit: int | None, count: int) -> Graph:
        """Returns the graph of a build of up to `count` inverses that keeps at most `limit` multiprocessors busy."""
        if self._generation != self._workspace.generation:  # graphs hold its addresses
            self._graphs, self._generation = {}, self._workspace.generation
        if (limit, count) not in self._graphs:
            stream = self._workspace.stream
            with stream:
                stream.begin_capture()
                try:
                    for number, batch in enumerate(self._layout.batches):
                        self._batch(number, batch, limit, min(count, self.most))
                finally:
                    graph = stream.end_capture()
                self._graphs[limit, count] = graph
        return self._graphs[limit, count]

    def _batch(self, number: int, batch: BuildBatch, limit: int | None, copies: int) -> None:
        """Launches the kernels that build the parts of a batch, of up to so many inverses."""
        space, parts, last = self._workspace, self._parts, np.int32(self.plan.size)
        memory, builds = (np.uint64(a.data.ptr) for a in (space.memory, space.incoming))
        diagonal, finish, *merges = self._tasks[number]
        strides = np.zeros((), STRIDES)
        strides["value"], strides["g"], strides["first_t"] = self._nonzeros, batch.cleared // 4, 0
        if copies > 1:  # then there is one batch: G of all, then T of all
            strides["t"] = (self._layout.size - batch.cleared) // 4
            strides["first_t"] = (copies - 1) * (batch.cleared // 4)

        def launch(name: str, tasks: DeviceArray, *more: Any) -> None:
            count = np.int32(len(tasks))
            self._launch(name, limit, copies * len(tasks), parts, tasks, count, memory, strides, builds, *more)

        self._gpu.cp.cuda.runtime.memsetAsync(int(memory), 0, copies * batch.cleared, space.stream.ptr)
        columns, count = np.uint64(self._columns.data.ptr + COLUMN.itemsize * batch.first), batch.last - batch.first
        self._launch(
            "scatter", limit, copies * count, parts, columns, np.int32(count), self._place, np.uint64(builds + HEAD),
            memory, strides, np.int32(number == 0), last, builds,
        )  # fmt: skip
        launch("invert", diagonal)
        for tasks in merges:
            launch("couple", tasks)
            launch("merge", tasks)
        launch("lengths", diagonal, last)
        launch("finish", finish, self._boundary, self._row_chunk, self._out_chunk, np.int32(self.plan.planes))

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
