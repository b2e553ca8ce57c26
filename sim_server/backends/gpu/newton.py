# SPDX-License-Identifier: MIT
"""Newton-Raphson iteration within a step on a GPU (newton.cu): its memory and its launches.

The first assembly of a step is that of scenes with one linearization. A trial needs no more than the forces, so the
blocks of A are made where a linearization follows. All after the first trial is a loop of the graph, which repeats
while a body is not done. A driver without such loops has all trials that the scene allows in the graph of a step, one
after another, linearizations x (1 + trials) of them, and launches that no body needs any more return at once. For the
bodies that are done, the kernels of trials begin with a guard (kernel_fusion.PhaseGuard).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.conditions import Loop
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction, KernelModule
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import (
    DOMAINS,
    FusedKernel,
    Opening,
    PhaseGuard,
    Prologue,
    SolveGuard,
    fuse,
)
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.structs import NEWTON_RESULT
from sim_server.backends.newton import Newton

NEWTON = Declarations("backends/gpu/newton.cu")
BLOCK_NODES: int = NEWTON.constant("BLOCK_NODES")  # of a thread block
PARTS: int = NEWTON.constant("PARTS")  # of such nodes, each of a thread block of the kernel `update_state`
LANES: int = NEWTON.constant("LANES")  # threads of a node there
NODE_RANGE = NEWTON.dtype("NodeRange")
SEARCH = NEWTON.dtype("Search")
NEWTON_ARGUMENTS = NEWTON.dtype("NewtonArguments")


class NewtonPhases(NamedTuple):
    """State of the Newton iterations that launches of a step read, on the device.

    active: (1,), number of bodies whose iteration is not over
    phase: (bodies,), phase of each body's iteration (kernels/newton_line_search.cuh)
    search: (bodies,) of SEARCH as bytes
    """

    active: DeviceArray
    phase: DeviceArray
    search: DeviceArray

    @classmethod
    def initial(cls, gpu: Gpu, bodies: int) -> "NewtonPhases":
        """Returns the state before the first step."""
        zeros = gpu.cp.zeros
        return cls(gpu.cp.full(1, bodies, np.int32), zeros(bodies, np.int32), zeros(bodies * SEARCH.itemsize, np.uint8))

    def of_solves(self, errors: bool) -> tuple[DeviceArray, ...]:
        """Returns what the solver reads. errors: whether it judges trials (bounded_search.cuh)."""
        return (self.active, self.phase, self.search) if errors else (self.active, self.phase)

    def guard(self, body: DeviceArray | None, blocks: bool = False) -> PhaseGuard:
        """Returns the guard of a kernel. body: (items,), body of each item; None: not known. blocks: it makes those
        of A."""
        kind = SolveGuard if blocks else PhaseGuard
        return kind(self.active.data.ptr, self.phase.data.ptr, 0 if body is None else body.data.ptr)


class Loops(Protocol):
    """A device whose graphs may have loops (cuda.CudaDevice).

    has_conditions: whether they do
    """

    @property
    def has_conditions(self) -> bool: ...

    def loop(self) -> Loop:
        """Makes a loop of the graph that is captured now, whose kernels tell it whether it goes on."""
        ...

    def linked(self, text: str, name: str, options: Sequence[str]) -> KernelModule:
        """Compiles a text whose kernels tell loops."""
        ...


def node_ranges(ranges: Int64) -> NDArray[Any]:
    """Returns the nodes of each thread block (NODE_RANGE).

    ranges: (bodies, 2), nodes [first, last) of each body.
    """
    count = -(-(ranges[:, 1] - ranges[:, 0]) // BLOCK_NODES)
    start = np.concatenate([[0], np.cumsum(count)])
    found = np.zeros(start[-1], NODE_RANGE)
    body = found["body"] = np.repeat(np.arange(len(ranges)), count)
    found["first"] = ranges[body, 0] + BLOCK_NODES * (np.arange(len(body)) - start[body])
    found["last"] = np.minimum(found["first"] + BLOCK_NODES, ranges[body, 1])
    found["first_range"], found["ranges"] = start[body], count[body]
    return found


def own_blocks(row_start: Int32, columns: Int32) -> Int32:
    """Returns the place of each node's own block, (nodes,); -1 at fixed nodes, whose rows have no other.

    columns: with any room behind the last row
    """
    rows = np.repeat(np.arange(len(row_start) - 1), np.diff(row_start))
    places = np.flatnonzero(columns[: len(rows)] == rows)
    return np.where(np.diff(row_start) > 1, places, -1).astype(np.int32)


def bodies_of(parts: Sequence[Int32 | None]) -> Int32 | None:
    """Returns the body of each item of a fused kernel, (items,); None if not known or different among its launches.

    parts: per launch (bodies + 1,), the first item of each body; None: not known.
    """
    first = parts[0] if parts else None
    if first is None or first[-1] == 0 or not all(p is not None and np.array_equal(p, first) for p in parts):
        return None
    return np.repeat(np.arange(len(first) - 1, dtype=np.int32), np.diff(first))


def begins_beside(assemble: Sequence[DeviceLaunch], ranges: Sequence[tuple[int, int]], errors: bool) -> Prologue | None:
    """Returns what begins the iteration beside the kernel over blocks of the first assembly; None: there is none.

    errors: whether the error of positions is bounded. The arguments are those that NewtonIteration sets.
    """
    domains = {launch.domain for launch in assemble}
    if not {"nodes", "blocks"} <= domains <= set(DOMAINS):
        return None
    text = ("#define ERRORS\n" if errors else "") + '#include "newton_begin.cuh"'
    blocks = len(node_ranges(np.array(ranges, np.int64)))
    return Prologue(text, "NewtonArguments", "begin_beside", np.zeros((), NEWTON_ARGUMENTS), blocks)


class NewtonIteration:
    """Launches the Newton iteration of a step, between its first assembly and its end.

    device: on which graphs are captured
    newton: options, arrays, and `parts` of the launches in `again`
    again: launches that assemble the system once more
    ranges: nodes [first, last) of each body
    arrays: host arrays by name (row_start, columns, values, b, y, x, v)
    results: host memory (capacity, bodies) of NEWTON_RESULT that the steps write to
    readers: launches after the step's end that read what the last assembly made
    beside: begins the iteration within the first assembly; None: a launch of its own does
    within: whether the kernel that integrates ends the iteration (ending); else a launch of its own does

    The array `values` keeps A of the first linearization of a step, from which factors are made; later ones have
    another.

    loops: whether the graph of a step has a loop
    rounds: most times that the loop, or the graph, has the launches of a trial in a step

    Raises InputError for more trials than a graph without loops may hold.
    """

    def __init__(
        self, gpu: Gpu, device: Loops, newton: Newton, again: Sequence[DeviceLaunch], ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], phases: NewtonPhases, solver: PcgSolver, results: NDArray[Any],
        readers: Sequence[DeviceLaunch] = (), beside: Prologue | None = None, within: bool = False,
    ):  # fmt: skip
        self._gpu, self._device, self._solver, self._phases = gpu, device, solver, phases
        self.rounds = newton.options.rounds + solver.errors  # one solve more judges the last trial that is allowed
        self.loops = device.has_conditions
        if not self.loops:
            newton.options.check_unrolled()
        first_values: DeviceArray = gpu.twin(arrays["values"])
        self._values: DeviceArray = gpu.cp.empty_like(first_values)  # A of later linearizations
        self._bodies: list[DeviceArray | None] = []  # of the items of each kernel
        later = [launch.with_array(first_values, self._values) for launch in again]
        self._forces, self._blocks = self._guarded(newton, later, phases, readers)
        spans = node_ranges(np.array(ranges, np.int64))
        self._grid = len(spans)
        self._memory = self._arrays(newton, spans, ranges, arrays)
        self._params = beside.params if beside else np.zeros((), NEWTON_ARGUMENTS)
        self._begins_beside, self._ends_within = beside is not None, within
        self._set_arguments(newton, len(ranges), len(arrays["x"]), results)
        self._later_params = self._params.copy()
        self._later_params["values"] = self._values.data.ptr
        kinds = {"ERRORS": solver.errors, "BUDGETS": solver.budgets}
        defined = [kind for kind, wanted in kinds.items() if wanted]
        self._definitions = "".join(f"#define {kind}\n" for kind in defined)
        module = self._module(f"-D{kind}" for kind in defined)
        self._begin, self._update_state, self._accept_trial, self._end = (
            compiled("newton.cu", module, name)
            for name in ("begin_newton", "update_state", "accept_trial", "end_newton")
        )

    def _arrays(
        self, newton: Newton, spans: NDArray[Any], ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]]
    ) -> dict[str, DeviceArray]:
        """Returns what the kernels work with, by names of NewtonArguments. spans: nodes of each thread block"""
        cp, solver, nodes, bodies = self._gpu.cp, self._solver, len(arrays["x"]), len(ranges)
        names = ("row_start", "columns", "values", "b", "y", "x", "v")
        host = {name: arrays[name] for name in names} | newton.arrays
        twins: dict[str, DeviceArray] = {name: self._gpu.twin(array) for name, array in host.items()}
        return twins | {
            "ranges": cp.asarray(spans.view(np.int32)),
            "diagonal": cp.asarray(own_blocks(arrays["row_start"], arrays["columns"])),
            "body": cp.asarray(np.repeat(np.arange(bodies, dtype=np.int32), [last - first for first, last in ranges])),
            "partial_sums": cp.zeros(2 * PARTS * len(spans)), "finished_blocks": cp.zeros(bodies, np.uint32),
            **self._phases._asdict(), "begun": solver.begun, "clocks": solver.clocks, "step": solver.counter,
            "pool_counter": solver.pool_counter, "results": solver.results,
            "initial_state": cp.zeros(12 * nodes, twins["x"].dtype), "increment": cp.zeros(3 * nodes),
            "direction": cp.zeros(3 * nodes),
        }  # fmt: skip

    def _set_arguments(self, newton: Newton, bodies: int, nodes: int, results: NDArray[Any]) -> None:
        """Sets the arguments of the kernels (NewtonArguments). bodies, nodes: numbers of the scene's"""
        params, given = self._params, newton.options
        for name, array in self._memory.items():
            params[name] = array.data.ptr
        params["newton_results"], params["bodies"] = results.ctypes.data, self._solver.bodies_device
        params["dx_dv"], params["tolerance"] = newton.dx_dv, given.tolerance
        params["linearizations"], params["trials"] = given.linearizations, given.trials
        params["nodes"], params["count"], params["grid"] = nodes, bodies, self._grid
        params["capacity"] = results.nbytes // NEWTON_RESULT.itemsize // bodies

    def _module(self, definitions: Iterable[str]) -> KernelModule:
        """Compiles newton.cu, for a loop of the graph where there may be one."""
        flags = (*options(self._gpu.types), *own_headers(), *definitions)
        if self.loops:
            return self._device.linked(NEWTON.checked(), "newton.cu", (*flags, "-DLOOPS"))
        module: KernelModule = self._gpu.cp.RawModule(code=NEWTON.checked(), options=flags, backend="nvrtc")
        return module

    def _guarded(
        self, newton: Newton, again: Sequence[DeviceLaunch], phases: NewtonPhases, readers: Sequence[DeviceLaunch]
    ) -> tuple[list[FusedKernel | DeviceLaunch], list[FusedKernel | DeviceLaunch]]:
        """Fuses the launches, each kernel with its guard: those that make the forces, and those of the blocks of A."""
        parts = {id(launch): part for launch, part in zip(again, newton.parts, strict=True)}

        def guard(group: Sequence[DeviceLaunch]) -> PhaseGuard:
            known = [parts[id(launch)] for launch in group if not launch.mailed]
            body = bodies_of(known)
            self._bodies.append(None if body is None else self._gpu.cp.asarray(body))
            return phases.guard(self._bodies[-1], blocks=group[0].domain == "blocks")

        blocks = [launch for launch in again if launch.domain == "blocks"]
        forces = [launch for launch in again if launch.domain != "blocks"]
        made = fuse(forces, guard, readers=[*blocks, *readers])
        return made, fuse(blocks, guard, readers=[*forces, *readers])

    def follow(self, row_start: Int32, columns: Int32) -> tuple[DeviceArray, Int32]:
        """Returns the array that follows the pattern of A, and its contents for this one."""
        return self._memory["diagonal"], own_blocks(row_start, columns)

    def ending(self) -> Opening | None:
        """Returns what ends the iteration at the beginning of the kernel that integrates, if that does it."""
        text = f'{self._definitions}#include "newton_end.cuh"'
        return Opening(text, "NewtonArguments", "end_item", "end_within", self._params) if self._ends_within else None

    def launch(self) -> None:
        """Launches the whole iteration of a step whose first linearization has been assembled.

        Where graphs have loops, only while one is captured.
        """
        if not self._begins_beside:
            self._launch(self._begin, BLOCK_NODES, self._params)
        loop = self._device.loop() if self.loops else None
        self._trial(self._params, None, loop)
        if loop:
            with loop.body():
                self._later_trial(loop)
        else:
            for _ in range(self.rounds - 1):
                self._later_trial(None)
        if not self._ends_within:
            self._launch(self._end, BLOCK_NODES, self._params)

    def _later_trial(self, loop: Loop | None) -> None:
        """Launches a trial after the first one, of a new linearization or of a shorter step."""
        for launch in self._blocks:
            launch()
        self._trial(self._later_params, self._values, loop)

    def _trial(self, params: NDArray[Any], values: DeviceArray | None, loop: Loop | None) -> None:
        """Launches a solve, the state that it gives, the forces there and the decision. values: A; None: the first."""
        told = np.uint64(loop.handle if loop else 0)
        self._solver.launch(values)
        self._launch(self._update_state, BLOCK_NODES // PARTS * LANES, params, told, parts=PARTS)
        for launch in self._forces:
            launch()
        self._launch(self._accept_trial, BLOCK_NODES, params, told)

    def _launch(
        self, function: KernelFunction, threads: int, params: NDArray[Any], *told: np.uint64, parts: int = 1
    ) -> None:  # fmt: skip
        function((self._grid * parts,), (threads,), (params, *told))
