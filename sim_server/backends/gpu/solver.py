# SPDX-License-Identifier: MIT
"""Memory and launch of the persistent conjugate gradient kernel (pcg.cu)."""

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Int32, Int64
from sim_server.backends.compiler import SOURCES
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.helper import FarInverse, FarVectors, Helper
from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder, InverseStorage, builder_kernels
from sim_server.backends.gpu.inverse.device_digits import LARGE, LargeFactors, digits_kernels
from sim_server.backends.gpu.inverse.device_plan import DevicePlan, shared_bytes
from sim_server.backends.gpu.inverse.digits import library as digits_library
from sim_server.backends.gpu.inverse.digits import planes_of
from sim_server.backends.gpu.inverse.plan import plan
from sim_server.backends.gpu.solver_features import SolverFeatures
from sim_server.backends.gpu.solver_layout import SolverLayout
from sim_server.backends.gpu.structs import CORRECTION, PCG, PCG_RESULT

T = TypeVar("T")

PCG_BODY = PCG.dtype("PcgBody")
SETTINGS_BYTES = PCG_BODY.fields["factor_step"][1]  # type: ignore[index]
"""Bytes of a PCG_BODY before the factor: the settings."""


def _factor_part() -> np.dtype[Any]:
    """Returns the fields of a PCG_BODY that are the factor: what is behind its settings."""
    fields: Any = PCG_BODY.fields
    names = [name for name in PCG_BODY.names or () if fields[name][1] >= SETTINGS_BYTES]
    offsets = [fields[name][1] - SETTINGS_BYTES for name in names]
    size = PCG_BODY.itemsize - SETTINGS_BYTES
    told: Any = {"names": names, "formats": [PCG_BODY[name] for name in names], "offsets": offsets, "itemsize": size}
    made: np.dtype[Any] = np.dtype(told)
    return made


FACTOR = _factor_part()
PLAIN = SolverFeatures()
PCG_ARGUMENTS, TRIAL_CLOCK = PCG.dtype("PcgArguments"), PCG.dtype("TrialClock")


def _bytes_of(rows: NDArray[np.void]) -> NDArray[np.uint8]:
    """Returns the bytes of some rows, (rows, bytes)."""
    return rows.view(np.uint8).reshape(len(rows), rows.itemsize)


class PlannedInverse(NamedTuple):
    """A plan of inverses on the device, and what builds them."""

    plan: DevicePlan
    builder: InverseBuilder
    far: DevicePlan | None = None  # in the memory of a second GPU


class PcgSolver:
    """Solves the linear systems of all bodies in one launch (pcg.cu).

    ranges: nodes [first, last) of each body
    arrays: host arrays by name (row_start, columns, values, b, y, moving); their twins on the device are used
    counter: device array (1,), number of completed steps
    capacity: number of steps whose results are kept
    features: what the solves do beside the plain iteration; those that are used

    followed: what follows the pattern of A where that changes (`follow`), else None
    threads, grid: threads of a thread block, and thread blocks of a launch
    params: arguments of the kernel (PCG_ARGUMENTS)
    bodies: host rows (PCG_BODY), one per body. The loop uploads the settings (the first SETTINGS_BYTES bytes of a row)
        and the factor (the others) separately.
    results: device ring (capacity, bodies) of PCG_RESULT
    pool_counter: device array, one number for each launch of a step, zero at launch
    spared: multiprocessors that a launch leaves free
    """

    def __init__(
        self, gpu: Gpu, ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]], counter: DeviceArray,
        capacity: int, features: SolverFeatures = PLAIN,
    ):  # fmt: skip
        self.gpu, self.counter, self._capacity = gpu, counter, capacity
        self.planes, self.errors, self.budgets = features.planes, features.errors, features.budgets
        self._twins = {name: gpu.twin(arrays[name]) for name in ("row_start", "values", "b", "y", "moving")}
        self.real = np.dtype(self._twins["values"].dtype)
        self._types = {"real": "float" if self.real == np.float32 else "double"}
        if features.between:
            self._types["local"] = gpu.types["local"]
        layout = self._layout = SolverLayout.of(gpu, ranges, arrays, features)
        self.threads, self.grid, self.spared = layout.threads, layout.grid, layout.spared
        self.followed, self._shared = layout.followed, layout.shared
        if layout.assigned.pooled:
            features = replace(features, smoothing=None)  # smoothed.cu has no pool
        self.features = features
        self.bodies = np.zeros(len(ranges), PCG_BODY)
        row, part = PCG_BODY.itemsize, np.dtype((np.void, FACTOR.itemsize))  # NumPy copies fields one by one
        self._factor_part = np.ndarray(len(ranges), part, self.bodies.data, SETTINGS_BYTES, (row,))
        self.bodies["first"], self.bodies["nodes"] = layout.spans[:, 0], layout.nodes
        self.bodies["blocks"], self.bodies["first_range"] = layout.assigned.blocks, layout.partition.first
        self._work = self._memory(len(arrays["row_start"]) - 1)
        self._helped, self._helper = np.zeros(len(ranges), bool), features.helper
        if self._helper:
            self._helped = self._connected(self._helper)
        self._blocks_of: list[int] = (self.bodies["blocks"] * np.where(self._helped, 2, 1)).tolist()  # of all GPUs
        self.params = self._arguments(len(arrays["row_start"]) - 1)
        self._device = gpu.cp.cuda.Device()
        self._planner = ThreadPoolExecutor(1, "plans of inverses")
        self._compile()
        self._large = LargeFactors(gpu)
        if self.planes is None:
            digits_library()  # before a factor waits for it
        self._lock = threading.Lock()
        self._plans: dict[tuple[int, int, int], Future[PlannedInverse]] = {}  # by pattern, planes, thread blocks
        self._vectors: dict[tuple[int, int], dict[str, DeviceArray]] = {}  # by body and plan
        self._far_vectors: dict[tuple[int, int], FarVectors] = {}  # likewise, of bodies that a second GPU helps
        self._plan_in_row: dict[int, DevicePlan] = {}  # by body
        self._factor_bytes = [0] * len(ranges)

    def _memory(self, nodes: int) -> dict[str, DeviceArray]:
        """Allocates what steps read and write, by names of PcgArguments. nodes: of the scene"""
        cp, layout, features, bodies, ints = self.gpu.cp, self._layout, self.features, len(self.bodies), np.int32
        self._rows = cp.zeros(self.bodies.nbytes, np.uint8)
        self.results: DeviceArray = cp.zeros(self._capacity * bodies * PCG_RESULT.itemsize, np.uint8)
        self.pool_counter: DeviceArray = cp.zeros(max(features.attempts, 1), np.uint32)
        vectors, sums = (12, 20) if self.errors else (9, 16)
        work: dict[str, DeviceArray] = {
            "order": cp.asarray(layout.order), "initial_range": cp.asarray(layout.initial_range),
            **{name: cp.asarray(array) for name, array in layout.lists.items()},
            "halo_values": cp.zeros(3 * layout.halo, self.real), "halo_position": cp.zeros(layout.halo, ints),
            "own_vectors": cp.zeros(vectors * nodes, self.real),
            "z": cp.zeros(6 * nodes), "diagonal": cp.zeros(9 * nodes, self.real),
            "block_sums": cp.zeros(sums * self.grid * bodies),
            "exchange_number": cp.ones(bodies, np.uint32),  # unwritten words have the number 0
            "pool_counter": self.pool_counter, "results": self.results, "step": self.counter,
            "begun": cp.zeros(1, np.int64), "clocks": cp.zeros(bodies * TRIAL_CLOCK.itemsize, np.uint8),
        }  # fmt: skip
        if features.smoothing:
            work |= features.smoothing.memory
        if features.cut:
            work["at_rest"] = self.gpu.twin(features.cut.at_rest)
            assert work["at_rest"].dtype == self.real
        if self.followed:
            work["split_step"] = cp.zeros(bodies, np.int64)
        return work

    def _connected(self, helper: Helper) -> NDArray[np.bool_]:
        """Gives a second GPU what it shares with this one; returns which bodies it helps, (bodies,)."""
        layout = self._layout
        helped = helper.helped(layout.nodes, layout.assigned.first >= 0, layout.per_processor)
        helper.connect_solver(
            layout.nodes, self.threads, self._shared, layout.partition.ranges, layout.initial_range, self._types
        )
        return helped

    def _compile(self) -> None:
        """Compiles the kernels of a step, two at a time."""
        smoothed = self.beside(lambda: self._compiled("smoothed")) if self.features.smoothing else None
        self._function = self._compiled("pcg")
        self._smoothed = smoothed.result() if smoothed else None
        application = self.features.application
        self._application = self._compiled(application) if application else None

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

    def _compiled(self, name: str) -> KernelFunction:
        """Compiles the kernel of the text <name>.cu."""
        features, text = self.features, (SOURCES / f"backends/gpu/{name}.cu").read_text()
        corrected = name == "pcg" and features.correction
        module = self.gpu.cp.RawModule(
            code=text + features.declared.assertions() + (CORRECTION.assertions() if corrected else ""),
            options=(
                *options(self._types), *own_headers(), f"-DTHREADS={self.threads}",
                f"-DPER_PROCESSOR={self._layout.per_processor}", *features.definitions(name, self._layout.alone),
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
        phases = (np.uint64(array.data.ptr) for array in self.features.phases)
        arguments = (params, *phases, *self._corrected)
        self._function((self.grid,), (self.threads,), arguments, shared_mem=self._shared)
        if self._smoothed:
            self._smoothed((self.grid,), (self.threads,), (params,), shared_mem=self._shared)

    @property
    def _corrected(self) -> tuple[NDArray[Any], ...]:
        """The last arguments of pcg.cu, if there are any."""
        parts = self.features.correction, self._helper
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
        key = pattern.id, planes, self._blocks_of[body]
        if (known := self._plans.get(key)) is not None:  # as nearly always, without the lock
            return known
        with self._lock:
            if key in self._plans:
                return self._plans[key]
            made = self._plans[key] = self.beside(lambda: self._planned(pattern, key[2], planes))
        made.add_done_callback(partial(self._forget_failed, key))
        return made

    def thread_blocks(self, bodies: Int64) -> list[int]:
        """Returns the thread blocks of bodies, of all GPUs, for which inverses are planned."""
        return [self._blocks_of[body] for body in bodies.tolist()]

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
        if (needed := shared_bytes(found, self.threads // 32)) > self._shared:
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
        own = blocks // 2 if helper else blocks
        far = helper.plan(found) if helper else None
        return PlannedInverse(DevicePlan(self.gpu, found, 0 if self._helper else None, own), builder, far)

    def without_vectors(self, bodies: Sequence[int], plan: DevicePlan) -> list[int]:
        """Returns the rows of bodies that `reserve_vectors` makes vectors for."""
        there, far, at = self._vectors, self._far_vectors, plan.address
        return [row for row, body in enumerate(bodies) if (body, at) not in there and (body, at) not in far]

    def reserve_vectors(self, body: int, plan: DevicePlan) -> bool:
        """Allocates the vectors of solves of a body with factors of this plan, unless they are there; returns whether
        it did. From any thread; the caller has them complete before a step reads them."""
        key = body, plan.address
        if key in self._vectors or key in self._far_vectors:  # as nearly always, without the lock
            return False
        with self._lock:
            if self._helper and self._helped[body]:
                if key not in self._far_vectors:
                    self._far_vectors[key] = self._helper.vectors(plan)
            elif key not in self._vectors:
                self._vectors[key] = plan.vectors()
        return True

    def use(
        self, bodies: Int64, planned: PlannedInverse, storages: Sequence[InverseStorage], planes: int,
        steps: Sequence[int],
    ) -> NDArray[np.uint8]:  # fmt: skip
        """Writes factors whose inverses have one plan into the host rows of bodies, and returns them (`factor_rows`);
        each is in use once its row is uploaded. steps: of their matrices"""
        in_row = self._plan_in_row
        for body in [body for body in bodies.tolist() if in_row.get(body) is not planned.plan]:
            self._use_plan(body, planned.plan, planes)
        rows = self._factor_part[bodies]
        factors, targets = rows.view(FACTOR), np.array([storage.target for storage in storages], np.uint64)
        factors["matrix"], factors["scale"] = targets[:, 0], targets[:, 1]
        factors["factor_step"], factors["helper"] = steps, 0
        self._factor_part[bodies] = rows
        if self._helper:
            for body, storage in zip(bodies.tolist(), storages, strict=True):
                if storage.far:
                    self._use_far(body, planned, storage.far)
            return self.factor_rows(bodies)
        return _bytes_of(rows)

    def factor_rows(self, bodies: Int64) -> NDArray[np.uint8]:
        """Returns what the host rows of bodies tell of their factors, (bodies, bytes)."""
        return _bytes_of(self._factor_part[bodies])

    def _use_plan(self, body: int, device_plan: DevicePlan, planes: int) -> None:
        """Has a body use factors of another plan."""
        row = self.bodies[body]
        self._plan_in_row[body] = device_plan
        row["plan"], row["planes"] = device_plan.address, planes
        self.reserve_vectors(body, device_plan)
        for name, address in self._addresses(body, device_plan).items():
            row[name] = address
        self._factor_bytes[body] = device_plan.bytes

    def _use_far(self, body: int, planned: PlannedInverse, far: FarInverse) -> None:
        """Has a second GPU use its part of an inverse."""
        assert self._helper is not None and planned.far is not None
        row = self.bodies[body]
        row["helper"] = self._helper.use(row, far, planned.far, self._far_vectors[body, planned.plan.address])

    def _addresses(self, body: int, plan: DevicePlan) -> dict[str, int]:
        """Returns the addresses of the vectors of a body, by name."""
        key = body, plan.address
        if key in self._far_vectors:
            return self._far_vectors[key].here
        return {name: int(array.data.ptr) for name, array in self._vectors[key].items()}

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes that an application of the factor in a body's host row reads, 0 without one."""
        return self._factor_bytes[body]

    def _arguments(self, nodes: int) -> NDArray[Any]:
        """Returns the arguments of the kernels. nodes: of the scene"""
        params = np.zeros((), PCG_ARGUMENTS)
        params["bodies"], params["count"], params["capacity"] = self.bodies_device, len(self.bodies), self._capacity
        for name, array in (self._twins | self._work).items():
            params[name] = array.data.ptr
        params["pooled"], params["grid"] = self._layout.assigned.pooled, self.grid
        params["nodes"], params["shared"] = nodes, self._shared
        return params
