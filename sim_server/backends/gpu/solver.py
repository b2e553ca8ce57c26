# SPDX-License-Identifier: MIT
"""Memory and launch of the persistent conjugate gradient kernel (pcg.cu)."""

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Int32, Int64
from sim_server.backends.base import CutInput
from sim_server.backends.compiler import SOURCES
from sim_server.backends.gpu.correction import FactorCorrection
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.followed_rows import FollowedRows
from sim_server.backends.gpu.helper import LEAST_NODES, FarVectors, Helper
from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder, PartitionedInverse, builder_kernels
from sim_server.backends.gpu.inverse.device_digits import LARGE, LargeFactors, digits_kernels
from sim_server.backends.gpu.inverse.device_plan import DevicePlan, shared_bytes
from sim_server.backends.gpu.inverse.digits import library as digits_library
from sim_server.backends.gpu.inverse.digits import planes_of
from sim_server.backends.gpu.inverse.plan import plan
from sim_server.backends.gpu.row_partition import (
    COLUMN_BITS,
    SPARED,
    best_assignment,
    halo,
    initial_ranges,
    lists_of,
    mirrored,
)
from sim_server.backends.gpu.smoothing import FactorSmoothing
from sim_server.backends.gpu.structs import CONTACT, CORRECTION, PCG, PCG_RESULT, STAGES
from sim_server.errors import InputError

T = TypeVar("T")

PCG_BODY = PCG.dtype("PcgBody")
SETTINGS_BYTES = PCG_BODY.fields["factor_step"][1]  # type: ignore[index]
"""Bytes of a PCG_BODY before the factor: the settings."""
PCG_ARGUMENTS, TRIAL_CLOCK = PCG.dtype("PcgArguments"), PCG.dtype("TrialClock")


class PlannedInverse(NamedTuple):
    """A plan of inverses on the device, and what builds them."""

    plan: DevicePlan
    builder: InverseBuilder
    far: DevicePlan | None = None  # in the memory of a second GPU


# Bytes in shared memory of a block of A, of a node, and of the rest (spmv.cuh).
BLOCK_BYTES, NODE_BYTES, OTHER_BYTES = 76, 216, 5120
FILLING = 100  # nodes of a body that keep a multiprocessor busy


def threads_and_blocks(
    nodes: Int64, blocks: Int64, processors: int, shared: int, exchanges: bool = True
) -> tuple[int, int]:
    """Returns threads per thread block and thread blocks per multiprocessor.

    Bodies of many small ones have a multiprocessor for themselves, one after another, since its shared memory then
    holds half of A and much of the factor. Tiny ones do not fill one: four are on a multiprocessor, or two if that is
    what it takes to have their rows of A in its shared memory, which else pass through it in every iteration.

    nodes, blocks (bodies,): of each body and of its rows of A. shared: bytes of a multiprocessor. exchanges: True if a
    body may not be solved as one that exchanges nothing (block_group.cuh), which keeps half of A
    """
    if len(nodes) <= processors - SPARED:
        return 256, 1  # 255 registers a thread: spilling to local memory costs a trip to L2
    if not exchanges and len(nodes) > 1.5 * processors and np.median(nodes) >= FILLING:
        return 256, 1
    if len(nodes) <= 2 * processors or np.median(nodes) >= 300:
        return 128, 2
    needed = np.median(BLOCK_BYTES * blocks + NODE_BYTES * nodes) + OTHER_BYTES
    return (128, 2) if shared / 4 < needed <= shared / 2 else (64, 4)


def alone(nodes: Int64, blocks: Int64, count: Int64) -> bool:
    """Returns whether each body is solved by one thread block, which then needs no exchanges (block_group.cuh).

    nodes, blocks, count (bodies,): of each body, of its rows of A, and thread blocks
    """
    fits = nodes.max() <= 1 << COLUMN_BITS and blocks.max() < 1 << 31 - COLUMN_BITS  # into a word of spmv.cuh
    return len(count) > 1 and bool(fits) and int(count.max()) == 1


class PcgSolver:
    """Solves the linear systems of all bodies in one launch (pcg.cu).

    ranges: nodes [first, last) of each body
    arrays: host arrays by name (row_start, columns, values, b, y, moving); their twins on the device are used
    counter: device array (1,), number of completed steps
    capacity: number of steps whose results are kept
    planes: float16 numbers per entry of an inverse; 1, or 2 for 22 bits; None: as each factor needs (digits.py)
    phases: NewtonPhases.of_solves (newton.py); empty: one linearization a step
    attempts: number of solves that the graph of a Rosenbrock-W step holds (stages.cuh); 0: another scheme
    contact: True for a scene with contact (contact_state.cuh)
    between: True if bodies touch each other, or are tied, there (island_state.cuh)
    correction: of factors for grabs and contacts; None: they are not corrected
    errors: True for a scene whose solves estimate the errors of positions (iterate_error.cuh)
    budgets: True for a scene whose solves may end by their wall time (step_budget.cuh); they estimate errors, too
    smoothing: of factors that are too old; None: they are left as they are
    cut: what tells of nodes that lose elements, and how many blocks A has at most; None: no body can be cut
    helper: a second GPU that applies half of the inverses of large bodies

    followed: what follows the pattern of A then (`follow`), else None
    params: arguments of the kernel (PCG_ARGUMENTS)
    bodies: host rows (PCG_BODY), one per body. The loop uploads the settings (the first SETTINGS_BYTES bytes of a row)
        and the factor (the others) separately.
    results: device ring (capacity, bodies) of PCG_RESULT
    pool_counter: device array, one number for each launch of a step, zero at launch
    spared: multiprocessors that a launch leaves free
    """

    def __init__(
        self, gpu: Gpu, ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]], counter: DeviceArray,
        capacity: int, planes: int | None = 1, phases: Sequence[DeviceArray] = (), attempts: int = 0,
        contact: bool = False, between: bool = False, correction: FactorCorrection | None = None, errors: bool = False,
        budgets: bool = False, cut: CutInput | None = None, smoothing: FactorSmoothing | None = None,
        helper: Helper | None = None,
    ):  # fmt: skip
        cp, processors = gpu.cp, gpu.properties["multiProcessorCount"]
        self.gpu, self.counter, self._capacity, self.planes, self._phases = gpu, counter, capacity, planes, phases
        self._attempts, self._contact, self._correction, self.errors = attempts, contact, correction, errors
        self.budgets, self._cut, self._helper = budgets, cut, helper
        most_blocks = cut.most_blocks if cut else ()
        self._twins = {name: gpu.twin(arrays[name]) for name in ("row_start", "values", "b", "y", "moving")}
        self.real = np.dtype(self._twins["values"].dtype)
        self._types = {"real": "float" if self.real == np.float32 else "double"}
        if between:
            self._types["local"] = gpu.types["local"]
        spans = np.array(ranges, np.int64)
        nodes = spans[:, 1] - spans[:, 0]
        rows = np.diff(arrays["row_start"].astype(np.int64)[spans], axis=1)[:, 0]
        shared = gpu.properties["sharedMemPerMultiprocessor"]
        exchanges = bool(phases or attempts or between or most_blocks or smoothing or helper)
        self.threads, blocks = threads_and_blocks(nodes, rows, processors, shared, exchanges)
        assigned, most = best_assignment(nodes, processors, blocks)
        self.grid = most if assigned.pooled else int(assigned.blocks.sum())
        self.spared = processors - -(-self.grid // blocks)
        self._alone = not exchanges and alone(nodes, rows, assigned.blocks)
        self.bodies = np.zeros(len(ranges), PCG_BODY)
        self.bodies["first"], self.bodies["nodes"] = spans[:, 0], nodes
        self.bodies["blocks"] = assigned.blocks
        pattern = arrays["row_start"], arrays["columns"]
        self.followed = FollowedRows(spans, assigned.blocks, most_blocks) if most_blocks else None
        if self.followed:
            partition, lists, read = self.followed.partition(*pattern), self.followed.of(*pattern), self.followed.halo
        else:
            partition = halo(spans, assigned.blocks, *pattern)
            lists, read = lists_of(partition), len(partition.nodes)
        if self._alone:
            lists |= mirrored(partition, *pattern, self.threads // 32)
        self.bodies["first_range"] = partition.first
        self._rows = cp.zeros(self.bodies.nbytes, np.uint8)
        self.results: DeviceArray = cp.zeros(capacity * len(ranges) * PCG_RESULT.itemsize, np.uint8)
        self.pool_counter: DeviceArray = cp.zeros(max(attempts, 1), np.uint32)
        total, ints = len(arrays["row_start"]) - 1, np.int32
        self._work: dict[str, DeviceArray] = {
            "order": cp.asarray(np.tile(assigned.order.astype(ints), 2)),
            "initial_range": cp.asarray(initial_ranges(assigned, partition, self.grid)),
            **{name: cp.asarray(array) for name, array in lists.items()},
            "halo_values": cp.zeros(3 * read, self.real), "halo_position": cp.zeros(read, ints),
            "own_vectors": cp.zeros((12 if errors else 9) * total, self.real),
            "z": cp.zeros(6 * total), "diagonal": cp.zeros(9 * total, self.real),
            "block_sums": cp.zeros((20 if errors else 16) * self.grid * len(ranges)),
            "exchange_number": cp.ones(len(ranges), np.uint32),  # unwritten words have the number 0
            "pool_counter": self.pool_counter, "results": self.results, "step": counter,
            "begun": cp.zeros(1, np.int64), "clocks": cp.zeros(len(ranges) * TRIAL_CLOCK.itemsize, np.uint8),
        }  # fmt: skip
        smoothing = None if assigned.pooled else smoothing  # smoothed.cu has no pool
        if smoothing:
            self._work |= smoothing.memory
        if cut:
            self._work["at_rest"] = gpu.twin(cut.at_rest)
            assert self._work["at_rest"].dtype == self.real
        if self.followed:
            self._work["split_step"] = cp.zeros(len(ranges), np.int64)
        fixed = 5120 if correction else 2048  # bytes: shared memory that pcg.cu declares, and the driver's
        fixed += 1024 if self.threads > 256 else 0
        self._shared = (gpu.properties["sharedMemPerMultiprocessor"] // blocks - fixed - 1024) // 16 * 16
        self._helped = np.zeros(len(ranges), bool)
        if helper:
            self._helped = (nodes >= LEAST_NODES) & (assigned.first >= 0)
            if blocks > 1:
                raise InputError(
                    f"solver.gpus = 2 with {len(nodes)} objects, of which a multiprocessor takes several at a time: "
                    "allowed is 1"
                )
            if not self._helped.any():
                raise InputError(
                    f"solver.gpus = 2: the largest object has {nodes.max()} nodes; two GPUs are for objects of "
                    f"{LEAST_NODES} and more, allowed is 1"
                )
            initial = initial_ranges(assigned, partition, self.grid)
            helper.connect_solver(nodes, self.threads, self._shared, partition.ranges, initial, self._types)
        self.params = self._arguments(total, assigned.pooled)
        self._device = cp.cuda.Device()
        self._planner = ThreadPoolExecutor(1, "plans of inverses")
        made = self.beside(lambda: self._compiled("smoothed", blocks)) if smoothing else None
        self._function = self._compiled("pcg", blocks)
        self._smoothed = made.result() if made else None
        application = "apply_factor" if attempts else "island_factor" if between else None
        self._application = self._compiled(application, blocks) if application else None
        self._large = LargeFactors(gpu)
        if planes is None:
            digits_library()  # before a factor waits for it
        self._lock = threading.Lock()
        self._plans: dict[tuple[int, int, int], Future[PlannedInverse]] = {}  # by pattern, planes, thread blocks
        self._vectors: dict[tuple[int, int], dict[str, DeviceArray]] = {}  # by body and plan
        self._far_vectors: dict[tuple[int, int], FarVectors] = {}  # likewise, of bodies that a second GPU helps
        self._plan_in_row: dict[int, DevicePlan] = {}  # by body
        self._factor_bytes = [0] * len(ranges)

    @property
    def bodies_device(self) -> int:
        """Address of the rows of the bodies on the device."""
        return int(self._rows.data.ptr)

    @property
    def begun(self) -> DeviceArray:
        """Time at which the step under way began, on the device's clock [ns], (1,); the end of a step writes it."""
        return self._work["begun"]

    @property
    def clocks(self) -> DeviceArray:
        """Wall times of the searches of the bodies (TRIAL_CLOCK)."""
        return self._work["clocks"]

    @property
    def split_step(self) -> DeviceArray:
        """Steps completed when each body was split last, (bodies,); there only where bodies may be split."""
        return self._work["split_step"]

    def follow(self, row_start: Int32, columns: Int32) -> list[tuple[DeviceArray, NDArray[Any]]]:
        """Returns the arrays that follow the pattern of A, and their contents for this one."""
        assert self.followed is not None
        return [(self._work[name], array) for name, array in self.followed.of(row_start, columns).items()]

    def forget_plans(self, kept: Collection[tuple[int, int]]) -> None:
        """Frees plans of factors of all but these patterns (FactorPattern.id) and planes, which no step may use any
        more."""
        with self._lock:
            gone = [key for key, made in self._plans.items() if key[:2] not in kept and made.done()]
            made = [self._plans.pop(key) for key in gone]
            addresses = {each.result().plan.address for each in made if each.exception() is None}
            self._vectors = {key: made for key, made in self._vectors.items() if key[1] not in addresses}
            self._far_vectors = {key: made for key, made in self._far_vectors.items() if key[1] not in addresses}

    def _compiled(self, name: str, blocks: int) -> KernelFunction:
        """Compiles the kernel of the text <name>.cu for `blocks` thread blocks a multiprocessor."""
        declared = STAGES if self._attempts else CONTACT if self._contact else PCG
        numbers = {"THREADS": self.threads, "PER_PROCESSOR": blocks}
        text, corrected = (SOURCES / f"backends/gpu/{name}.cu").read_text(), name == "pcg" and self._correction
        module = self.gpu.cp.RawModule(
            code=text + declared.assertions() + (CORRECTION.assertions() if corrected else ""),
            options=(
                *options(self._types), *own_headers(),
                *(f"-D{name}={number}" for name, number in numbers.items()),
                *(["-DNEWTON_PHASES"] if self._phases else []), *(["-DSTAGES"] if self._attempts else []),
                *(["-DCONTACT_PASSES"] if self._contact else []), *(["-DCORRECTED"] if corrected else []),
                *(["-DERRORS"] if self.errors and name == "pcg" else []),
                *(["-DBUDGETS"] if self.budgets and name == "pcg" else []),
                *(["-DSMOOTHED"] if "slow" in self._work and name == "pcg" else []),
                *(["-DCUTS"] if self._cut and name == "pcg" else []),
                *(["-DALONE"] if self._alone and name == "pcg" else []),
                *(["-DSPLITS"] if self.followed else []),
                *(["-DHELPED"] if self._helper and name == "pcg" else []),
            ),
            backend="nvrtc",
            enable_cooperative_groups=True,
        )  # fmt: skip
        function = compiled(f"{name}.cu", module, name)
        function.max_dynamic_shared_size_bytes = self._shared
        return function

    def launch(self, values: DeviceArray | None = None) -> None:
        """Launches a solve of all bodies. values: of A, in place of those of the scene's array."""
        params = self.params
        if values is not None:
            params = params.copy()
            params["values"] = values.data.ptr
        phases = (np.uint64(array.data.ptr) for array in self._phases)
        arguments = (params, *phases, *self._corrected)
        self._function((self.grid,), (self.threads,), arguments, shared_mem=self._shared)
        if self._smoothed:
            self._smoothed((self.grid,), (self.threads,), (params,), shared_mem=self._shared)

    @property
    def _corrected(self) -> tuple[NDArray[Any], ...]:
        """The last arguments of pcg.cu, if there are any."""
        parts = self._correction, self._helper
        return tuple(part.params for part in parts if part)

    def solve_contact(self, b: DeviceArray, contact: NDArray[Any]) -> None:
        """Launches a solve of a step with contact (contact_state.cuh).

        b: (nodes, 3), right-hand side. contact: CONTACT_SOLVE
        """
        params = self.params.copy()
        params["b"] = b.data.ptr
        self._function((self.grid,), (self.threads,), (params, contact, *self._corrected), shared_mem=self._shared)

    def apply_island_factors(self, islands: NDArray[Any]) -> None:
        """Launches the application of factors in an iteration of bodies that touch each other (island_factor.cu).

        islands: ISLAND_ARGUMENTS
        """
        assert self._application is not None
        self._application((self.grid,), (self.threads,), (self.params, islands), shared_mem=self._shared)

    def iterate(self, number: int, stage: NDArray[Any]) -> None:
        """Launches solve `number` of a Rosenbrock-W step by iterations. stage: STAGE_SOLVE."""
        self._launch_stage(self._function, number, stage)

    def apply_factors(self, number: int, stage: NDArray[Any]) -> None:
        """Launches solve `number` of a Rosenbrock-W step by factors alone (apply_factor.cu)."""
        assert self._application is not None
        self._launch_stage(self._application, number, stage)

    def _launch_stage(self, function: KernelFunction, number: int, stage: NDArray[Any]) -> None:
        params = self.params.copy()
        params["pool_counter"] += np.uint64(self.pool_counter.dtype.itemsize * number)
        function((self.grid,), (self.threads,), (params, stage), shared_mem=self._shared)

    def compile_builder(self) -> None:
        """Has the kernels that build inverses compiled beside the caller, before a factor waits for them."""
        self.beside(lambda: builder_kernels(self.gpu))
        if self.planes is None:
            self.beside(lambda: digits_kernels(self.gpu))

    def planes_of(self, factors: Sequence[tuple[FactorPattern, NDArray[Any]]]) -> list[int]:
        """Returns the float16 numbers per entry that the inverse of each of some factors gets. From any thread."""
        return planes_of(factors) if self.planes is None else [self.planes] * len(factors)

    def brought(self, values: NDArray[Any] | DeviceValues) -> NDArray[Any] | DeviceValues:
        """Returns values of a large factor on the device, if there is memory for them. In the thread of the plans."""
        return self._large.brought(values)

    def planes_on_device(self, pattern: FactorPattern, values: DeviceValues, multiprocessors: int | None) -> int:
        """As `planes_of`, estimated on the device. In the thread of the plans. multiprocessors: that this keeps busy
        at most; None: all"""
        return self._large.planes_for(pattern, values, multiprocessors) if self.planes is None else self.planes

    def beside(self, work: Callable[[], T]) -> Future[T]:
        """Has work done in the thread of the plans, one after another."""

        def on_device() -> T:
            self._device.use()  # the current device is one of each thread
            return work()

        return self._planner.submit(on_device)

    def begin_plan(self, body: int, pattern: FactorPattern, planes: int | None = None) -> Future[PlannedInverse]:
        """Returns the plan of the inverse of factors of this pattern for a body, and its builder: at first, they are
        made in a thread. Its result raises what `plan` raises. planes: float16 numbers per entry; None: those of
        usual factors"""
        planes = planes or self.planes or 1
        blocks = int(self.bodies[body]["blocks"]) * (2 if self._helped[body] else 1)
        key = (pattern.id, planes, blocks)
        with self._lock:
            if key in self._plans:
                return self._plans[key]
            made = self._plans[key] = self.beside(lambda: self._planned(pattern, blocks, planes))
        made.add_done_callback(partial(self._forget_failed, key))
        return made

    @property
    def plans_made(self) -> bool:
        """True if no plan is being made."""
        with self._lock:
            return all(made.done() for made in self._plans.values())

    def _forget_failed(self, key: tuple[int, int, int], made: Future[PlannedInverse]) -> None:
        """Has a plan that could not be made tried again the next time: memory may be free then."""
        if made.exception() is not None:
            with self._lock:
                if self._plans.get(key) is made:
                    del self._plans[key]

    def _planned(self, pattern: FactorPattern, blocks: int, planes: int) -> PlannedInverse:
        found = plan(pattern, blocks, planes=planes, shared=self._shared)
        if (needed := shared_bytes(found)) > self._shared:
            raise ValueError(
                f"{pattern.size} degrees of freedom in {blocks} thread blocks need {needed} bytes of shared memory "
                f"each, allowed: {self._shared}"
            )
        alike = 3 * self.bodies["nodes"] == pattern.size
        helper = self._helper if (self._helped & alike).any() else None  # bodies of one size are all helped, or none
        most = int((alike & (self.bodies["blocks"] == blocks // (2 if helper else 1))).sum())
        builder = InverseBuilder(self.gpu, pattern, found, most, helper)
        if self.planes is None and 4 * pattern.nonzeros > LARGE:
            self._large.expect(pattern)
        warps, own = self.threads // 32, blocks // 2 if helper else blocks
        far = helper.plan(found, warps) if helper else None
        return PlannedInverse(DevicePlan(self.gpu, found, warps, 0 if self._helper else None, own), builder, far)

    def plan(self, body: int, pattern: FactorPattern, planes: int) -> DevicePlan:
        """Returns the plan of the inverse of factors of this pattern for a body; waits until it is made.

        Raises ValueError if the pattern has no plan (inverse.plan.plan) or needs more shared memory than there is.
        """
        return self.begin_plan(body, pattern, planes).result().plan

    def reserve_vectors(self, body: int, plan: DevicePlan) -> None:
        """Allocates the vectors of solves of a body with factors of this plan, unless they are there. From any thread;
        the caller has them complete before a step reads them."""
        with self._lock:
            key = body, plan.address
            if self._helper and self._helped[body]:
                if key not in self._far_vectors:
                    self._far_vectors[key] = self._helper.vectors(plan)
            elif key not in self._vectors:
                self._vectors[key] = plan.vectors()

    def use(self, body: int, pattern: FactorPattern, inverse: PartitionedInverse, planes: int, step: int) -> None:
        """Writes a factor into the host row of a body; it is in use once the row is uploaded."""
        device_plan, row = self.plan(body, pattern, planes), self.bodies[body]
        row["matrix"], row["scale"], row["factor_step"] = inverse.matrix, inverse.scale, step
        if self._plan_in_row.get(body) is not device_plan:
            self._plan_in_row[body] = device_plan
            row["plan"], row["planes"] = device_plan.address, planes
            self.reserve_vectors(body, device_plan)
            for name, address in self._addresses(body, device_plan).items():
                row[name] = address
            self._factor_bytes[body] = device_plan.bytes
        row["helper"] = 0
        if self._helper and inverse.far:
            far_plan = self.begin_plan(body, pattern, planes).result().far
            assert far_plan is not None
            row["helper"] = self._helper.use(row, inverse.far, far_plan, self._far_vectors[body, device_plan.address])

    def _addresses(self, body: int, plan: DevicePlan) -> dict[str, int]:
        """Returns the addresses of the vectors of a body, by name."""
        key = body, plan.address
        if key in self._far_vectors:
            return self._far_vectors[key].here
        return {name: int(array.data.ptr) for name, array in self._vectors[key].items()}

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes that an application of the factor in a body's host row reads, 0 without one."""
        return self._factor_bytes[body]

    def _arguments(self, nodes: int, pooled: int) -> NDArray[Any]:
        params = np.zeros((), PCG_ARGUMENTS)
        params["bodies"], params["count"], params["capacity"] = self.bodies_device, len(self.bodies), self._capacity
        for name, array in (self._twins | self._work).items():
            params[name] = array.data.ptr
        params["pooled"], params["grid"], params["nodes"], params["shared"] = pooled, self.grid, nodes, self._shared
        return params
