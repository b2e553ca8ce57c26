# SPDX-License-Identifier: MIT
"""Newton-Raphson iteration within a step on a GPU (newton.cu): its memory and its launches.

The graph of a step holds all trials that the scene allows, linearizations x (1 + trials); launches that no body needs
any more return at once. The first assembly of a step is that of scenes with one linearization; the kernels of the later
ones begin with a guard (kernel_fusion.PhaseGuard).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import FusedKernel, PhaseGuard, fuse
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.structs import NEWTON_RESULT
from sim_server.backends.newton import Newton

NEWTON = Declarations("backends/gpu/newton.cu")
BLOCK_NODES: int = NEWTON.constant("BLOCK_NODES")  # of a thread block
LANES: int = NEWTON.constant("LANES")  # threads of a node in the kernel `update_state`
NODE_RANGE = NEWTON.dtype("NodeRange")
SEARCH = NEWTON.dtype("Search")
NEWTON_ARGUMENTS = NEWTON.dtype("NewtonArguments")


class NewtonPhases(NamedTuple):
    """State of the Newton iterations that launches of a step read, on the device.

    active: (1,), number of bodies whose iteration is not over
    phase: (bodies,), phase of each body's iteration (kernels/newton_line_search.cuh)
    """

    active: DeviceArray
    phase: DeviceArray

    @classmethod
    def initial(cls, gpu: Gpu, bodies: int) -> "NewtonPhases":
        """Returns the state before the first step."""
        return cls(gpu.cp.full(1, bodies, np.int32), gpu.cp.zeros(bodies, np.int32))

    def guard(self, body: DeviceArray | None) -> PhaseGuard:
        """Returns the guard of a kernel. body: (items,), body of each item; None: not known."""
        return PhaseGuard(self.active.data.ptr, self.phase.data.ptr, 0 if body is None else body.data.ptr)


def node_ranges(ranges: Int64) -> tuple[NDArray[Any], Int32]:
    """Returns the nodes of each thread block (NODE_RANGE), and the first thread block of each body, (bodies + 1,).

    ranges: (bodies, 2), nodes [first, last) of each body.
    """
    count = -(-(ranges[:, 1] - ranges[:, 0]) // BLOCK_NODES)
    start = np.concatenate([[0], np.cumsum(count)])
    found = np.zeros(start[-1], NODE_RANGE)
    body = found["body"] = np.repeat(np.arange(len(ranges)), count)
    found["first"] = ranges[body, 0] + BLOCK_NODES * (np.arange(len(body)) - start[body])
    found["last"] = np.minimum(found["first"] + BLOCK_NODES, ranges[body, 1])
    return found, start.astype(np.int32)


def bodies_of(parts: Sequence[Int32 | None]) -> Int32 | None:
    """Returns the body of each item of a fused kernel, (items,); None if not known or different among its launches.

    parts: per launch (bodies + 1,), the first item of each body; None: not known.
    """
    first = parts[0] if parts else None
    if first is None or first[-1] == 0 or not all(p is not None and np.array_equal(p, first) for p in parts):
        return None
    return np.repeat(np.arange(len(first) - 1, dtype=np.int32), np.diff(first))


class NewtonIteration:
    """Launches the Newton iteration of a step, between its first assembly and its end.

    newton: options, arrays, and `parts` of the launches in `again`
    again: launches that assemble the system once more
    ranges: nodes [first, last) of each body
    arrays: host arrays by name (row_start, columns, values, b, y, x, v)
    results: host memory (capacity, bodies) of NEWTON_RESULT that the steps write to
    readers: launches after the step's end that read what the last assembly made

    rounds: trials in a step
    first_values: A of the first linearization of the step, from which factors are made
    """

    def __init__(
        self, gpu: Gpu, newton: Newton, again: Sequence[DeviceLaunch], ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], phases: NewtonPhases, solver: PcgSolver, results: NDArray[Any],
        readers: Sequence[DeviceLaunch] = (),
    ):  # fmt: skip
        cp, nodes, bodies = gpu.cp, len(arrays["x"]), len(ranges)
        self._gpu, self._solver, self.rounds = gpu, solver, newton.options.rounds
        self._bodies: list[DeviceArray | None] = []  # of the items of each kernel
        self._again = self._guarded(newton, again, phases, readers)
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
            "initial_state": cp.zeros(12 * nodes, real), "increment": cp.zeros(3 * nodes),
            "direction": cp.zeros(3 * nodes),
        }  # fmt: skip
        self._params = np.zeros((), NEWTON_ARGUMENTS)
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        self._params["newton_results"], self._params["bodies"] = results.ctypes.data, solver.bodies_device
        self._params["dx_dv"], self._params["tolerance"] = newton.dx_dv, newton.options.tolerance
        self._params["linearizations"], self._params["trials"] = newton.options.linearizations, newton.options.trials
        self._params["nodes"], self._params["count"] = nodes, bodies
        self._params["capacity"] = results.nbytes // NEWTON_RESULT.itemsize // bodies
        self._values, self.first_values = twins["values"], cp.empty_like(twins["values"])
        flags = (*options(gpu.types), *own_headers())
        module = gpu.cp.RawModule(code=NEWTON.checked(), options=flags, backend="nvrtc")
        self._begin, self._update_state, self._accept_trial, self._end = (
            compiled("newton.cu", module, name)
            for name in ("begin_newton", "update_state", "accept_trial", "end_newton")
        )

    def _guarded(
        self, newton: Newton, again: Sequence[DeviceLaunch], phases: NewtonPhases, readers: Sequence[DeviceLaunch]
    ) -> list[FusedKernel | DeviceLaunch]:
        """Fuses the launches, each kernel with its guard."""
        parts = {id(launch): part for launch, part in zip(again, newton.parts, strict=True)}

        def guard(group: Sequence[DeviceLaunch]) -> PhaseGuard:
            known = [parts[id(launch)] for launch in group if not launch.mailed]
            body = bodies_of(known)
            self._bodies.append(None if body is None else self._gpu.cp.asarray(body))
            return phases.guard(self._bodies[-1])

        return fuse(again, guard, readers=readers)

    def launch(self) -> None:
        """Launches the whole iteration of a step whose first linearization has been assembled."""
        cuda, kept, values = self._gpu.cp.cuda, self.first_values, self._values
        to, stream = cuda.runtime.memcpyDeviceToDevice, cuda.get_current_stream().ptr
        cuda.runtime.memcpyAsync(kept.data.ptr, values.data.ptr, values.nbytes, to, stream)
        self._launch(self._begin, BLOCK_NODES)
        for _ in range(self.rounds):
            self._solver.launch()
            self._launch(self._update_state, BLOCK_NODES * LANES)
            for launch in self._again:
                launch()
            self._launch(self._accept_trial, BLOCK_NODES)
        self._launch(self._end, BLOCK_NODES)

    def _launch(self, function: KernelFunction, threads: int) -> None:
        function((self._grid,), (threads,), (self._params,))
