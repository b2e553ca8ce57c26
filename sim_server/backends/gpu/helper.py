# SPDX-License-Identifier: MIT
"""A second GPU of the host that applies half of the inverses of large bodies (helper.cu).

State, matrix and the vectors of the iteration stay on the first one. A plan has twice the thread blocks of a body; the
matrices of the second half are copied once an inverse is built. What the two exchange in an iteration are words that
each writes into the memory of the other (peer access).
"""

import threading
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int64
from sim_server.backends.base import EngineInput
from sim_server.backends.compiler import SOURCES
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction, Stream
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.inverse.device_plan import DevicePlan
from sim_server.backends.gpu.inverse.plan import CHUNK_BYTES, Plan
from sim_server.backends.gpu.structs import PCG
from sim_server.errors import DeviceError, InputError

LEAST_NODES = 15_000  # of a body that is helped: below, trips between the devices take longer than bytes
MOST_ROWS = 4096  # inverses at a time, of all bodies

HELPER = Declarations("backends/gpu/helper.cu")
HELP, HELPER_ARGUMENTS = HELPER.dtype("Help"), HELPER.dtype("HelperArguments")
COMMAND_WORDS: int = HELPER.constant("COMMAND_WORDS")
PCG_BODY = PCG.dtype("PcgBody")


_claims = threading.Lock()  # of what follows
_stepping: set[int] = set()  # devices on which a scene with a helper makes steps


class FarInverse:
    """The helper's part of an inverse.

    row: in Help.far and HelperArguments.bodies; free again once this object is gone
    first: first chunk of the storage that the helper has
    """

    def __init__(self, helper: "Helper", plan: Plan):
        self.row, self.first = helper.take_row(), int(plan.chunk_start[plan.blocks // 2])
        weakref.finalize(self, helper.free_row, self.row)
        self.count = plan.chunks - self.first
        with helper.device:
            zeros = helper.cp.zeros
            self.matrix, self.scale = (
                zeros(max(self.count, 1) * CHUNK_BYTES, np.uint8),
                zeros(plan.size + 1, np.float32),
            )
            helper.cp.cuda.get_current_stream().synchronize()


class FarVectors(NamedTuple):
    """Words of a body's vectors on both devices, by name, and the bytes between them."""

    here: dict[str, int]
    there: dict[str, int]
    kept: tuple[DeviceArray, DeviceArray]

    @property
    def far(self) -> int:
        """Bytes from a word to the helper's copy."""
        return self.there["z"] - self.here["z"]


class Helper:
    """The second GPU of a scene, the next one after that of the steps.

    Raises DeviceError if there is no such device, or no peer access to it.
    """

    @classmethod
    def wanted(cls, gpu: Gpu, given: EngineInput) -> "Helper | None":
        """Returns the second GPU of a scene that asks for one. Raises InputError if it cannot help there."""
        if given.solver.gpus == 1:
            return None
        contact, solver = given.contact, given.solver
        refused = {
            "scheme ros2": given.stages, "explicit steps": given.substeps,
            "contact between bodies, attachments and springs": contact and (contact.surfaces or contact.ties),
            "bodies that may be split": given.cut and given.cut.most_blocks,
            f'preconditioner = "{solver.preconditioner}"': not solver.wants_factors,
        }  # fmt: skip
        if words := [name for name, there in refused.items() if there]:
            raise InputError(f"solver.gpus = {solver.gpus} with {words[0]}: allowed is 1, one GPU does all of it")
        return cls(gpu, int(gpu.cp.cuda.Device().id) + 1)

    def __init__(self, gpu: Gpu, index: int):
        cp = self.cp = gpu.cp
        self.gpu, self.index = gpu, index
        self._first = cp.cuda.Device()
        self.first = int(self._first.id)
        connect(cp, self.first, index)
        self.device = cp.cuda.Device(index)
        with self.device:
            self.stream: Stream = cp.cuda.Stream(non_blocking=True)
            self._far_writes: Stream = cp.cuda.Stream(non_blocking=True)
            self._forked, self._joined = cp.cuda.Event(disable_timing=True), cp.cuda.Event(disable_timing=True)
        self._writes: Stream = cp.cuda.Stream(non_blocking=True)
        self._fork = cp.cuda.Event(disable_timing=True)
        self._lock = threading.Lock()
        self._free = list(range(MOST_ROWS - 1, 0, -1))

    def take_row(self) -> int:
        """Returns a row of the tables that no inverse has."""
        with self._lock:
            return self._free.pop()

    def free_row(self, row: int) -> None:
        """Gives a row back."""
        with self._lock:
            self._free.append(row)

    @staticmethod
    def helped(nodes: Int64, own: NDArray[np.bool_], per_processor: int) -> NDArray[np.bool_]:
        """Returns which bodies are helped, (bodies,). Raises InputError where none is.

        nodes, own (bodies,): of each body, and whether it has thread blocks of its own
        per_processor: thread blocks of a multiprocessor
        """
        found: NDArray[np.bool_] = (nodes >= LEAST_NODES) & own
        if per_processor > 1:
            raise InputError(
                f"solver.gpus = 2 with {len(nodes)} objects, of which a multiprocessor takes several at a time: "
                "allowed is 1"
            )
        if not found.any():
            raise InputError(
                f"solver.gpus = 2: the largest object has {nodes.max()} nodes; two GPUs are for objects of "
                f"{LEAST_NODES} and more, allowed is 1"
            )
        return found

    def connect_solver(
        self, nodes: Int64, threads: int, shared: int, ranges: NDArray[Any], initial_range: NDArray[np.int32],
        types: dict[str, str],
    ) -> None:  # fmt: skip
        """Makes what the solver and the helper share.

        nodes (bodies,); threads: of a thread block; shared: bytes of its dynamic shared memory
        ranges: ROW_RANGE of all thread blocks; initial_range (grid,): of each thread block; types: of kernel texts
        """
        cp, bodies = self.cp, len(nodes)
        self._bodies, self._grid, self._threads, self._shared = bodies, len(initial_range), threads, shared
        text = (SOURCES / "backends/gpu/helper.cu").read_text() + HELPER.assertions()
        chosen = (*options(types), *own_headers(), f"-DTHREADS={threads}", "-DPER_PROCESSOR=1")

        def function(name: str) -> KernelFunction:
            return compiled("helper.cu", cp.RawModule(code=text, options=chosen, backend="nvrtc"), name)

        self._far, self._sums = cp.zeros(MOST_ROWS, np.int64), cp.zeros(4 * len(ranges))
        self._sent, self._launches = cp.zeros(bodies, np.uint32), cp.zeros(1, np.uint32)
        self._dismiss = function("dismiss")
        cp.cuda.get_current_stream().synchronize()
        with self.device:
            self._rows, self._back = cp.zeros(MOST_ROWS * PCG_BODY.itemsize, np.uint8), cp.zeros(MOST_ROWS, np.int64)
            self._commands, self._launched = cp.zeros(COMMAND_WORDS * bodies), cp.zeros(1, np.uint32)
            self._ranges, self._initial = cp.asarray(ranges.view(np.int32)), cp.asarray(initial_range)
            self._help, self._count = function("help"), function("count_launch")
            self._help.max_dynamic_shared_size_bytes = shared
            cp.cuda.get_current_stream().synchronize()
        self.params = np.zeros((), HELP)
        arrays = {
            "far": self._far,
            "commands": self._commands,
            "sums": self._sums,
            "sent": self._sent,
            "launches": self._launches,
        }
        for name, array in arrays.items():
            self.params[name] = array.data.ptr
        self.params["ranges"] = len(ranges)
        arguments = self._arguments = np.zeros((), HELPER_ARGUMENTS)
        arrays = {
            "bodies": self._rows, "far": self._back, "commands": self._commands, "sums": self._sums,
            "launches": self._launched, "row_ranges": self._ranges, "initial_range": self._initial,
        }  # fmt: skip
        for name, array in arrays.items():
            arguments[name] = array.data.ptr
        arguments["ranges"], arguments["shared"] = len(ranges), shared

    def begin(self) -> None:
        """Appends its part of a step, which runs beside what follows on the current stream until `end`."""
        self._fork.record()
        with self.device:
            self.stream.wait_event(self._fork)
            with self.stream:
                self._help((self._grid,), (self._threads,), (self._arguments,), shared_mem=self._shared)
                self._count((1,), (1,), (self._launched,))
                self._joined.record()

    def end(self) -> None:
        """Appends the end of its part of a step, for which what follows waits."""
        self._dismiss(
            (1,), (32,), (np.uint64(self._commands.data.ptr), self._sent, self._launches, np.int32(self._bodies))
        )
        self.cp.cuda.get_current_stream().wait_event(self._joined)

    def storage(self, plan: Plan) -> FarInverse:
        """Allocates memory for its part of an inverse."""
        return FarInverse(self, plan)

    def plan(self, plan: Plan) -> DevicePlan:
        """Returns a plan in the helper's memory."""
        with self.device:
            made = DevicePlan(self.gpu, plan, 1, plan.blocks // 2)
            self.cp.cuda.get_current_stream().synchronize()
            return made

    def vectors(self, plan: DevicePlan) -> FarVectors:
        """Allocates the vectors of one body on both devices, as flag words with exchange number 0."""
        sizes = plan.vector_sizes()
        total = sum(sizes.values())
        here = self.cp.zeros(total)
        with self.device:
            there = self.cp.zeros(total)
            self.cp.cuda.get_current_stream().synchronize()
        starts = dict(zip(sizes, np.cumsum([0, *sizes.values()])[:-1].tolist(), strict=True))
        near, far = (
            {name: int(array.data.ptr) + 8 * start for name, start in starts.items()} for array in (here, there)
        )
        return FarVectors(near, far, (here, there))

    def copy(self, far: FarInverse, matrix: DeviceArray, scale: DeviceArray, stream: Stream) -> None:
        """Appends the copies of an inverse that the stream has made."""
        runtime = self.cp.cuda.runtime
        at, size = int(matrix.data.ptr) + CHUNK_BYTES * far.first, CHUNK_BYTES * far.count
        first, second = self.first, self.index
        if size:
            runtime.memcpyPeerAsync(far.matrix.data.ptr, second, at, first, size, stream.ptr)
        runtime.memcpyPeerAsync(far.scale.data.ptr, second, scale.data.ptr, first, scale.nbytes, stream.ptr)

    def use(self, row: NDArray[Any], far: FarInverse, plan: DevicePlan, vectors: FarVectors) -> int:
        """Writes an inverse that no step uses into the tables; returns its row. row: the body's (PCG_BODY)."""
        mine = row.copy()
        mine["plan"], mine["scale"] = plan.address, far.scale.data.ptr
        mine["matrix"] = far.matrix.data.ptr - CHUNK_BYTES * far.first
        for name, address in vectors.there.items():
            mine[name] = address
        self._write(self._writes, self._far.data.ptr + 8 * far.row, np.array([vectors.far]))
        with self.device:
            self._write(self._far_writes, self._rows.data.ptr + PCG_BODY.itemsize * far.row, mine.reshape(1))
            self._write(self._far_writes, self._back.data.ptr + 8 * far.row, np.array([-vectors.far]))
        return far.row

    def _write(self, stream: Stream, to: int, values: NDArray[Any]) -> None:
        """Copies an array to a device; returns once it is there."""
        runtime = self.cp.cuda.runtime
        runtime.memcpyAsync(to, values.ctypes.data, values.nbytes, runtime.memcpyHostToDevice, stream.ptr)
        stream.synchronize()


def alone(helper: Helper | None) -> AbstractContextManager[None]:
    """Returns a context for steps with this helper, which waits for nothing. It raises InputError while another
    scene makes steps with one of the two devices: thread blocks of each could wait for some that find no place."""
    return nullcontext() if helper is None else _alone((helper.first, helper.index))


@contextmanager
def _alone(devices: tuple[int, int]) -> Iterator[None]:
    with _claims:
        if _stepping.intersection(devices):
            raise InputError(
                "solver.gpus = 2: another scene of this process makes steps on these GPUs, and the two could wait for "
                "each other for ever: run one after the other, or each in a process of its own with other GPUs "
                "(CUDA_VISIBLE_DEVICES)"
            )
        _stepping.update(devices)
    try:
        yield
    finally:
        with _claims:
            _stepping.difference_update(devices)


def connect(cp: Any, first: int, second: int) -> None:
    """Lets two devices read and write the memory of each other. Raises DeviceError."""
    runtime = cp.cuda.runtime
    count = runtime.getDeviceCount()
    if not 0 <= second < count or first == second:
        raise DeviceError(
            f"solver.gpus = 2: no second GPU; CUDA shows {count} (CUDA_VISIBLE_DEVICES), steps run on number {first}"
        )
    for a, b in ((first, second), (second, first)):
        if not runtime.deviceCanAccessPeer(a, b):
            raise DeviceError(
                f"solver.gpus = 2: GPU {a} cannot access the memory of GPU {b} (peer access, as over NVLink)"
            )
        with cp.cuda.Device(a):
            try:
                runtime.deviceEnablePeerAccess(b)
            except runtime.CUDARuntimeError as error:
                if "PeerAccessAlreadyEnabled" not in str(error):
                    raise DeviceError(f"solver.gpus = 2: no peer access of GPU {a} to GPU {b}: {error}") from error
