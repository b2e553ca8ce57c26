# SPDX-License-Identifier: MIT
"""Newton-Raphson within a step on a GPU (newton.cu): its memory, and what it puts onto the stream.

All trials that a scene allows are in the graph of a step, linearizations x (1 + trials) of them; launches that nobody
needs any more return at once. The first assembly of a step is that of scenes with one linearization; the others are
made by the same texts with a guard in front (kernel_fusion.PhaseGuard).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.compiler import HERE
from sim_server.backends.cpu.structs import Search as SearchLayout
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import PhaseGuard, fused
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.structs import NEWTON_RESULT
from sim_server.mechanics.newton import Newton

BLOCK_NODES, LANES = 32, 8  # nodes of a thread block, threads of a node in `move`: newton.cu
NODE_RANGE = np.dtype([("body", "i4"), ("first", "i4"), ("last", "i4"), ("unused", "i4")])
SEARCH = np.dtype(SearchLayout)
POINTERS = (
    "ranges", "first_range", "partial_sums", "finished_blocks", "search", "phase", "active", "bad_node", "bodies",
    "results", "newton_results", "step", "pool_counter", "row_start", "columns", "values", "b", "y", "rotation", "mass",
    "beta", "x", "v", "ahead", "drift", "carried", "initial_state", "gain", "way",
)  # fmt: skip
NUMBERS = ("linearizations", "trials", "nodes", "count", "capacity", "unused")
NEWTON_ARGUMENTS = np.dtype(
    [(n, "u8") for n in POINTERS] + [("reach", "f8"), ("tolerance", "f8")] + [(n, "i4") for n in NUMBERS]
)


class NewtonPhases(NamedTuple):
    """Whose turn it is, on the device: searches that are left, (1,), and the phase of each body's (bodies,), of
    kernels/newton_line_search.cuh."""

    active: Any
    phase: Any

    @classmethod
    def of(cls, gpu: Gpu, bodies: int) -> "NewtonPhases":
        """Before the first step."""
        return cls(gpu.cp.full(1, bodies, np.int32), gpu.cp.zeros(bodies, np.int32))

    def guard(self, body: Any) -> PhaseGuard:
        """Of a kernel whose items are of these bodies; None: not known."""
        return PhaseGuard(self.active.data.ptr, self.phase.data.ptr, 0 if body is None else body.data.ptr)


def node_ranges(ranges: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[np.int32]]:
    """Nodes of each thread block (NODE_RANGE), and where those of each body begin, (bodies + 1,)."""
    count = -(-(ranges[:, 1] - ranges[:, 0]) // BLOCK_NODES)
    start = np.concatenate([[0], np.cumsum(count)])
    found = np.zeros(start[-1], NODE_RANGE)
    body = found["body"] = np.repeat(np.arange(len(ranges)), count)
    found["first"] = ranges[body, 0] + BLOCK_NODES * (np.arange(len(body)) - start[body])
    found["last"] = np.minimum(found["first"] + BLOCK_NODES, ranges[body, 1])
    return found, start.astype(np.int32)


def bodies_of(parts: Sequence[NDArray[np.int32] | None]) -> NDArray[np.int32] | None:
    """The body of each item of launches put together, (items,), from where the items of the bodies begin in each of
    them, (bodies + 1,); None where that is not known or not the same."""
    first = parts[0] if parts else None
    if first is None or first[-1] == 0 or not all(p is not None and np.array_equal(p, first) for p in parts):
        return None
    return np.repeat(np.arange(len(first) - 1, dtype=np.int32), np.diff(first))


class NewtonIteration:
    """The launches between the first assembly of a step and its end.

    newton: what to search for, with `parts` of the launches in `again`, which assemble a step once more. ranges: nodes
    [first, last) of each body. arrays: host arrays by name (row_start, columns, values, b, y, x, v). found: host memory
    (capacity, bodies) of NEWTON_RESULT that the steps write to.

    first_values: A as the step's first linearization had it, which is what factors are made of.
    """

    def __init__(
        self, gpu: Gpu, newton: Newton, again: Sequence[DeviceLaunch], ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], phases: NewtonPhases, solver: PcgSolver, found: NDArray[Any],
    ):  # fmt: skip
        cp, nodes, bodies = gpu.cp, len(arrays["x"]), len(ranges)
        self._gpu, self._solver, self.rounds = gpu, solver, newton.options.rounds
        self._bodies: list[Any] = []  # of the items of each kernel
        self._again = self._guarded(newton, again, phases)
        names = ("row_start", "columns", "values", "b", "y", "x", "v")
        host = {name: arrays[name] for name in names} | newton.arrays
        twins = {name: gpu.twin(array) for name, array in host.items()}
        spans, starts = node_ranges(np.array(ranges, np.int64))
        self._grid, real = len(spans), twins["x"].dtype
        self._memory = twins | {
            "ranges": cp.asarray(spans.view(np.int32)), "first_range": cp.asarray(starts),
            "partial_sums": cp.zeros(2 * len(spans)), "finished_blocks": cp.zeros(bodies, np.uint32),
            "search": cp.zeros(bodies * SEARCH.itemsize, np.uint8), "phase": phases.phase, "active": phases.active,
            "bad_node": cp.zeros(bodies, np.int32), "step": solver.counter, "pool_counter": solver.pool_counter,
            "results": solver.results,
            "initial_state": cp.zeros(12 * nodes, real), "gain": cp.zeros(3 * nodes), "way": cp.zeros(3 * nodes),
        }  # fmt: skip
        self._params = np.zeros((), NEWTON_ARGUMENTS)
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        self._params["newton_results"], self._params["bodies"] = found.ctypes.data, solver.bodies_device
        self._params["reach"], self._params["tolerance"] = newton.reach, newton.options.tolerance
        self._params["linearizations"], self._params["trials"] = newton.options.linearizations, newton.options.trials
        self._params["nodes"], self._params["count"] = nodes, bodies
        self._params["capacity"] = found.nbytes // NEWTON_RESULT.itemsize // bodies
        self._values, self.first_values = twins["values"], cp.empty_like(twins["values"])
        module = self._module()
        self._open, self._move, self._judge, self._close = (
            compiled("newton.cu", module, name) for name in ("open", "move", "judge", "close")
        )

    def _guarded(self, newton: Newton, again: Sequence[DeviceLaunch], phases: NewtonPhases) -> list[Any]:
        parts = {id(launch): part for launch, part in zip(again, newton.parts, strict=True)}

        def guard(group: Sequence[DeviceLaunch]) -> PhaseGuard:
            known = [parts[id(launch)] for launch in group if not launch.mailed]
            body = bodies_of(known)
            self._bodies.append(None if body is None else self._gpu.cp.asarray(body))
            return phases.guard(self._bodies[-1])

        return fused(again, guard)

    def _module(self) -> Any:
        sizes = {
            "NEWTON_ARGUMENTS": NEWTON_ARGUMENTS,
            "SEARCH": SEARCH,
            "NODE_RANGE": NODE_RANGE,
            "NEWTON_RESULT": NEWTON_RESULT,
        }
        return self._gpu.cp.RawModule(
            code=(HERE / "backends/gpu/newton.cu").read_text(),
            options=(
                *options(self._gpu.types), *own_headers(),
                *(f"-D{name}_BYTES={layout.itemsize}" for name, layout in sizes.items()),
            ),
            backend="nvrtc",
        )  # fmt: skip

    def launch(self) -> None:
        """Puts the whole search of a step that has been assembled onto the current stream."""
        cuda, kept, values = self._gpu.cp.cuda, self.first_values, self._values
        to, stream = cuda.runtime.memcpyDeviceToDevice, cuda.get_current_stream().ptr
        cuda.runtime.memcpyAsync(kept.data.ptr, values.data.ptr, values.nbytes, to, stream)
        self._put(self._open, BLOCK_NODES)
        for _ in range(self.rounds):
            self._solver.launch()
            self._put(self._move, BLOCK_NODES * LANES)
            for launch in self._again:
                launch()
            self._put(self._judge, BLOCK_NODES)
        self._put(self._close, BLOCK_NODES)

    def _put(self, function: Any, threads: int) -> None:
        function((self._grid,), (threads,), (self._params,))
