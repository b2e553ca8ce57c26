# SPDX-License-Identifier: MIT
"""The engine of a GPU: one CUDA graph per step.

The graph holds the launches of the scene and the persistent solver, whose stop test is on the device. The native loop
(loop.cpp) launches graphs, copies mail to the device and reads results. This module captures the graphs and posts
settings, factors and arguments.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.base import ArrayChange, Capability, EngineInput, Launch
from sim_server.backends.cpu.structs import REACTION
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.central_difference import ESTIMATE_EVERY, SubstepLoop
from sim_server.backends.gpu.contact import ContactPasses
from sim_server.backends.gpu.correction import FactorCorrection
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.cupy_types import DeviceArray, Graph
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.energies import DeviceEnergies
from sim_server.backends.gpu.factor_upload import FactorUpload
from sim_server.backends.gpu.held import HeldForces, leading
from sim_server.backends.gpu.helper import Helper
from sim_server.backends.gpu.kernel_fusion import DOMAINS, Epilogue, FusedKernel, Prologue, fuse
from sim_server.backends.gpu.known_patterns import KnownPatterns
from sim_server.backends.gpu.loop import CAPACITY, GRAPH_STEPS, DeviceLoop
from sim_server.backends.gpu.mailbox import ChangeMailbox, DeviceMailbox
from sim_server.backends.gpu.measured import MeasuredReport
from sim_server.backends.gpu.newton import NewtonIteration, NewtonPhases, begins_beside
from sim_server.backends.gpu.pinned import pinned_array
from sim_server.backends.gpu.rosenbrock import ATTEMPTS, RosenbrockStep
from sim_server.backends.gpu.shared_device_memory import SharedDeviceMemory
from sim_server.backends.gpu.smoothing import FactorSmoothing
from sim_server.backends.gpu.solver import PCG_BODY, SETTINGS_BYTES, PcgSolver
from sim_server.backends.gpu.solver_features import SolverFeatures
from sim_server.backends.gpu.splits import DeviceSplits, Staged
from sim_server.backends.gpu.state import device_array, device_arrays
from sim_server.backends.gpu.step_records import StepRecords
from sim_server.backends.gpu.structs import (
    CONTACT_RESULT,
    NEWTON_RESULT,
    PAIR_SUM,
    STAGE_RESULT,
    STEP_TIMESTAMP,
    SUBSTEP_RESULT,
    DeviceChanges,
    Mail,
)
from sim_server.backends.newton import Newton
from sim_server.backends.state import StateArray

MOST_GRABS = 1024  # pushes and grabs at a time, of which forces are told
MOST_TOLD = 16  # other bodies whose forces on a body are told, at most
GRAB_BLOCKS, GRAB_THREADS = 32, 128  # of the kernel react (effects/touch.cu)
PREPARED_WITHIN = 1.0  # s in which an inverse that is prepared for a check is begun, else the check goes without
AT_A_TIME = 2  # factors of a body: one comes while the one before it is built
MEMORY_AHEAD = 4 << 20, 256 << 20  # bytes of factors for which memory is taken before they come
FEW = 16  # largest number of trials in a step without loops for which several steps are captured in one graph
EPILOGUE = Declarations("backends/gpu/step_epilogue.cu")
STEP_EPILOGUE = EPILOGUE.dtype("StepEpilogue")


class DeviceSettings:
    """Solver settings of a body. An attribute that is set is valid from the next batch on."""

    def __init__(self, row: NDArray[Any], mailbox: DeviceMailbox):
        object.__setattr__(self, "_row", row)
        object.__setattr__(self, "_mailbox", mailbox)

    def __getattr__(self, name: str) -> Any:
        return self._row[name].item()

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "omega" or self._row[name] == value:  # no SSOR on a GPU
            return
        self._row[name] = value
        self._mailbox.post(self._row.tobytes()[:SETTINGS_BYTES])


class GpuEngine(DeviceLoop):
    """Runs the steps of a scene on a GPU.

    given: input from the scene
    records: capacity of the ring of records

    Raises errors that device.building translates, for lack of memory.
    """

    capabilities: frozenset[Capability] = frozenset()

    def __init__(self, gpu: Gpu, given: EngineInput, records: int | None = None):
        self._helper = Helper.wanted(gpu, given)
        assemble, integrate = (cast(Sequence[DeviceLaunch], part) for part in (given.assemble, given.integrate))
        self.launches, self._first = [*assemble, *integrate], assemble[: leading(assemble)]
        self._history = cast(Sequence[DeviceLaunch], given.history)
        assemble, settled = assemble[len(self._first) :], integrate[: leading(integrate)]
        integrate = integrate[len(settled) :]
        substep_forces: Sequence[DeviceLaunch] = ()  # which a step evaluates many times
        if given.substeps:
            substep_forces, assemble = assemble, []
        ranges, arrays, dt, newton = given.ranges, given.arrays, given.dt, given.newton
        stages, precision = given.stages, given.solver.factor_precision
        if precision == "auto" and stages is not None and stages.factor_alone:
            precision = "float32"
        planes = {"float16": 1, "float32": 2}.get(precision)  # float16 numbers per entry of an inverse
        budgets = bool(given.solver.budget or given.solver.step_budget)
        errors = given.errors or budgets
        self.gpu, self._arrays = gpu, arrays
        self._touched = [given.energies.touch[name] for name in ("force", "spring") if name in given.energies.touch]
        cp, bodies = gpu.cp, len(ranges)
        device = CudaDevice(cp)
        self._steps = device.step_stream
        self._counter: DeviceArray = cp.zeros(1, np.int64)  # completed steps
        self._timestamps = device.pinned(CAPACITY * STEP_TIMESTAMP.itemsize)
        self._energies = DeviceEnergies(gpu, given.energies, CAPACITY, self._counter, dt)
        alone = stages is not None and stages.factor_alone
        detection = (
            [x for x in assemble if x.domain not in DOMAINS] if given.contact else []
        )  # reads what the others make
        search = begins_beside(assemble, ranges, errors) if newton else None
        self._whole_assembly = self._beginning([x for x in assemble if x not in detection], detection, settled, search)
        forces = cast(Sequence[DeviceLaunch], stages.first) if stages else ()
        self._first_launches = self._beginning(forces) if alone else self._whole_assembly
        self._forces = fuse(forces) if alone else ()  # after a whole assembly, whose energy balance is made already
        phases = NewtonPhases.initial(gpu, bodies) if newton else None
        correction = self._correction = FactorCorrection.wanted(gpu, given)
        self._smoothing = None if self._helper else FactorSmoothing.wanted(gpu, given)  # which has half of the inverse
        most_blocks = given.cut.most_blocks if given.cut else ()
        surfaces = given.contact.surfaces if given.contact else None
        self._rows_of_bodies: tuple[NDArray[Any], ...] = (
            (given.contact.corner, given.contact.weight) if given.contact and surfaces else ()
        )
        self._prepared = False
        contact = given.contact
        features = SolverFeatures(
            planes, phases.of_solves(errors) if phases else (), ATTEMPTS if stages else 0, contact is not None,
            contact is not None and bool(contact.surfaces or contact.ties), correction, errors, budgets, given.cut,
            self._smoothing, self._helper,
        )  # fmt: skip
        self.solver = PcgSolver(gpu, ranges, arrays, self._counter, CAPACITY, features)
        self._newton, newton_results = None, None
        if newton and phases:
            newton_results = device.pinned(CAPACITY * NEWTON_RESULT.itemsize * bodies)
            parts = newton.parts[len(self._first) :]
            newton = Newton(newton.options, newton.dx_dv, parts, newton.detect, **newton.arrays)
            self._newton = NewtonIteration(
                gpu, device, newton, assemble, ranges, arrays, phases, self.solver, newton_results, settled, search,
                within=given.held is None,
            )  # fmt: skip
        self._splits: DeviceSplits | None = None
        if most_blocks:
            self._splits = DeviceSplits(gpu, given, self.solver, self._newton, self._counter)
        self._contact, contact_results, reactions, told = None, None, None, None
        self._ties = given.contact.ties if given.contact else None
        if given.contact:
            self._broken = device.pinned(4 * len(self._ties.broken) if self._ties else 0).view(np.int32)
            contact_results = device.pinned(CAPACITY * CONTACT_RESULT.itemsize * bodies)
            obstacles = len(given.contact.obstacles.kind)
            reactions = device.pinned(CAPACITY * bodies * obstacles * 48).view(np.float64)
            reactions = reactions.reshape(CAPACITY, bodies, obstacles, 6)
            balance = self._energies.balance
            if given.contact.surfaces:
                most = min(bodies - 1, MOST_TOLD)
                sums = device.pinned(CAPACITY * bodies * most * PAIR_SUM.itemsize).view(PAIR_SUM)
                counts = device.pinned(CAPACITY * bodies * 4).view(np.int32)
                told = sums.reshape(CAPACITY, bodies, most), counts.reshape(CAPACITY, bodies)
            self._contact = ContactPasses(
                gpu, device, given.contact, ranges, arrays, self.solver, balance, contact_results, reactions,
                self._broken, correction, told,
            )  # fmt: skip
            if self._contact.detects:
                self._whole_assembly = [*self._whole_assembly, self._contact.detect]
                self._first_launches = self._whole_assembly
        self._substeps, substep_results = None, None
        if given.substeps:
            substep_results = device.pinned(CAPACITY * SUBSTEP_RESULT.itemsize * bodies)
            self._substeps = SubstepLoop(
                gpu, device, given.substeps, substep_forces, settled, self.solver, self._energies.params, dt,
                substep_results,
            )  # fmt: skip
            integrate = [self._substeps.close]
        self._held, held = None, None
        if given.held is not None:
            held = device.pinned(CAPACITY * given.held.nbytes).view(np.float64).reshape(CAPACITY, *given.held.shape)
            self._held = HeldForces(gpu, settled, given.held, held, self._counter)
        self._measured, measured = None, None
        if given.measured:
            measured = device.pinned(CAPACITY * 8 * len(given.measured)).view(np.float64).reshape(CAPACITY, -1)
            self._measured = MeasuredReport(gpu, given.measured, measured, self._counter)
        row, first = PCG_BODY.itemsize, self.solver.bodies_device
        mailboxes = [(first + row * k, SETTINGS_BYTES) for k in range(bodies)]
        mailboxes += [(first + row * k + SETTINGS_BYTES, row - SETTINGS_BYTES) for k in range(bodies)]
        self._mailed = {k: len(mailboxes) + i for i, k in enumerate(k for k, x in enumerate(self.launches) if x.mailed)}
        mailboxes += [(self.launches[k].mail_address, self.launches[k].params.nbytes) for k in self._mailed]
        twins = {name: gpu.twin(arrays[name]) for name in ("values", "x", "v")}
        addresses = {name: int(twin.data.ptr) for name, twin in twins.items()}
        if self._contact:
            addresses["poses"] = self._contact.poses
        stage_results = device.pinned(CAPACITY * STAGE_RESULT.itemsize * bodies) if stages else None
        super().__init__(
            device, ranges, arrays["row_start"], dt, mailboxes, self._timestamps, arrays["clock"],
            records, twins["values"].dtype, newton_results, stage_results,
            contact_results, reactions, held, substep_results, most_blocks, **addresses,
        )  # fmt: skip
        if told:
            self.report_pairs(*told)
        if measured is not None:
            self.report_measured(given.measured, measured)
        kept = () if most_blocks else ranges  # patterns of what is split change
        upload = FactorUpload(gpu, self.solver, self, given.names, self.mailboxes[bodies : 2 * bodies])
        self._factor_upload = upload
        self._patterns = KnownPatterns(self.solver, upload.expect, kept, arrays["row_start"], arrays["columns"])
        for k in range(bodies):
            whole = self.solver.bodies[k : k + 1].tobytes()
            self.mailboxes[k].post(whole[:SETTINGS_BYTES])
            self.mailboxes[bodies + k].post(whole[SETTINGS_BYTES:])
        self.begin: Sequence[Launch] = ()  # launches before the first step
        self._changes, self._work_graphs = ChangeMailbox(self.loop), list[Graph]()
        self._graphs: list[Graph | None] = []
        self._epilogue = self._epilogue_params(dt)
        self._integrate, self.stages = None, None
        if stages and given.euler and stage_results is not None:
            self.stages = RosenbrockStep(
                gpu, device, stages, given.euler, assemble, self.solver, self._epilogue, stage_results, given.energies,
                gpu.twin(arrays["b"]), given.cut,
            )  # fmt: skip
            self._stamp_begin = self.stages.stamp_begin
        else:
            epilogue = Epilogue(EPILOGUE.checked(), "StepEpilogue", "finish_step", self._epilogue)
            ending = self._newton.ending() if self._newton else None
            self._integrate = FusedKernel(integrate, epilogue, opening=ending)
            self._stamp_begin = self._integrate.function("stamp_begin")
        self._known: Float64 = arrays["values"]  # as a factor is to know them
        self._expected: dict[int, Future[None]] = {}  # memory for factors that will come, by pattern
        self._matrix = self._matrix_launches(assemble) if alone else ()
        self._capture()
        if given.touch is not None:
            self._report_grabs(device, cast(DeviceLaunch, given.touch))
        cp.cuda.get_current_stream().synchronize()  # arrays are complete for the streams of the loop

    def _epilogue_params(self, dt: float) -> NDArray[Any]:
        """Returns the arguments of step_epilogue.cu."""
        self._finished_blocks: DeviceArray = self.gpu.cp.zeros(1, np.uint32)
        params = np.zeros((), STEP_EPILOGUE)
        arrays = {
            "clock": self.gpu.twin(self._arrays["clock"]), "step": self._counter,
            "pool_counters": self.solver.pool_counter, "finished_blocks": self._finished_blocks,
            "moving": self.gpu.twin(self._arrays["moving"]), "begun": self.solver.begun,
        }  # fmt: skip
        for name, array in arrays.items():
            params[name] = array.data.ptr
        params["timestamps"] = self._timestamps.ctypes.data
        params["dt"], params["counters"], params["capacity"] = dt, len(self.solver.pool_counter), CAPACITY
        params["bodies"] = len(self._ranges)
        return params

    # --- running ------------------------------------------------------------------------------------------------

    def run(self, steps: int) -> int:
        self._factor_upload.advance()
        self._make_ready()
        return super().run(steps)

    def _make_ready(self) -> None:
        """Runs the launches before the first step, and takes the initial state of the energy balance."""
        begins = bool(self.begin or self._substeps) and self.step == 0 and not self._prepared
        if self.step == 0:
            self.take_changes()
        if begins:
            for launch in self.begin:
                launch()
            if self._substeps:
                self._substeps.start()
        if not self._energies.started:
            self._energies.start()
            begins = True
        if begins:
            self.gpu.cp.cuda.get_current_stream().synchronize()

    def prepare(self) -> None:
        """Makes the state before the first step now, and not again when it begins."""
        self._make_ready()
        self._prepared = True

    def state(self) -> list[StateArray]:
        """Returns what the device carries on beside the arrays that launches write."""
        solves = self._correction, self._smoothing
        parts = (self._energies, self.stages, self._substeps, self._contact, *solves, self._splits)
        clock = self.gpu.twin(self._arrays["clock"])
        found = [device_array("engine.clock", clock), *(a for part in parts if part for a in part.state())]
        if self._rows_of_bodies:
            names = ("corner", "weight")
            twins = {name: self.gpu.twin(a, dtype=a.dtype) for name, a in zip(names, self._rows_of_bodies, strict=True)}
            found += device_arrays("engine.contact", twins, *names)
        return found

    def resume(self, step: int, start_time: float) -> None:
        """Goes on from a state that was written, after `step` steps."""
        self.loop.step = self.loop.launched = step
        self.loop.start_time, self._prepared, self._energies.started = start_time, True, True
        self._counter[:] = step
        self._arrays["clock"][:] = self.gpu.twin(self._arrays["clock"]).get()
        self.gpu.cp.cuda.get_current_stream().synchronize()

    def restart(self, bodies: Sequence[int]) -> None:
        """Begins the energy balances of bodies anew after a reset, while the loop stands still."""
        self._energies.start(bodies)
        if self._ties:
            self._broken[:] = self._ties.broken[:] = self.gpu.twin(self._ties.broken, dtype=np.dtype(np.int32)).get()
        self.gpu.cp.cuda.get_current_stream().synchronize()

    def restart_energy(self) -> None:
        """Restarts the energy balance from the state at the beginning of the next step, after x or v were set."""
        self._energies.started = False

    def _capture(self) -> None:
        """Captures the graphs of the steps, of the energies and of the records."""
        many = self._newton is None or self._newton.loops or self._newton.rounds <= FEW
        for begin in (False, True):
            for steps in GRAPH_STEPS:
                if steps > 1 and not many:
                    self._graphs.append(None)
                    continue
                with self._steps:
                    self._steps.begin_capture()
                    if begin:
                        self._begin()
                    for _ in range(steps):
                        self._one_step()
                    self._graphs.append(self._steps.end_capture())
        others = [self._captured(self._energies.launch_balance), self._captured(self._energies.launch_elastic)]
        if self._matrix:
            others.append(self._captured(self._assemble_matrix))
        writer = StepRecords(self.gpu, self.solver.results, self._energies.records, CAPACITY, self.loop)
        records = [self._captured(partial(self._report, writer, target)) for target in self.targets]
        handles = [int(graph.graphExec) if graph else 0 for graph in self._graphs]
        self.use_graphs(handles, [int(g.graphExec) for g in records], *(int(graph.graphExec) for graph in others))
        self._graphs += [*others, *records]  # kept as long as the engine
        self._second_half = None
        if self.stages or self._contact or self._substeps or (self._newton and self._newton.loops):
            self._second_half = self._captured(self._finish_step)

    def _report_grabs(self, device: CudaDevice, touch: DeviceLaunch) -> None:
        """Captures the kernel that writes the forces on grabs, which follows a step only while there are some."""
        reactions = device.pinned(CAPACITY * MOST_GRABS * REACTION.itemsize).view(REACTION)
        reactions = reactions.reshape(CAPACITY, MOST_GRABS)
        counts = device.pinned(CAPACITY * 8).view(np.int64)
        addresses = touch.mail_address, self._counter.data.ptr, reactions.ctypes.data, counts.ctypes.data
        arguments = (*map(np.uint64, addresses), np.int32(MOST_GRABS), np.int32(CAPACITY))
        kernel = touch.module.function("react")
        graph = self._captured(lambda: kernel((GRAB_BLOCKS,), (GRAB_THREADS,), arguments))
        self._graphs.append(graph)
        self.report_grabs(int(graph.graphExec), self._mailed[self.launches.index(touch)], reactions, counts)

    def _captured(self, launch: Callable[[], None]) -> Graph:
        """Returns the graph of the work that `launch` appends to the stream."""
        with self._steps:
            self._steps.begin_capture()
            launch()
            return self._steps.end_capture()

    def _report(self, records: StepRecords, target: int) -> None:
        """Appends what ends a batch: the energy balance of its last step, the others' are part of the next step's first
        kernel, and the records."""
        self._energies.launch_balance()
        records.launch(target)

    def _begin(self) -> None:
        """Launches the kernel that writes the time at which the step begins, for an idle device."""
        self._stamp_begin((1,), (1,), (self._epilogue,))

    def _beginning(
        self, assemble: Sequence[DeviceLaunch], after: Sequence[DeviceLaunch] = (),
        readers: Sequence[DeviceLaunch] = (), beside: Prologue | None = None,
    ) -> Sequence[Callable[[], None]]:  # fmt: skip
        """Fuses the assembly with the energy balance of the step before. after: launches that follow, one by one.
        readers: later ones that read what it makes. beside: done beside its last kernel.

        The balance is the prologue of a kernel over elements, since these write nothing that it reads. If it freezes a
        body meanwhile, the element results of this body do not matter, since its nodes are fixed then. What advances
        the history of materials comes after the balance: a frozen body has none.
        """
        domains = {launch.domain for launch in assemble}
        elements = "elements" in domains and domains <= set(DOMAINS) and not (self._first or self._history)
        balance = self._energies.prologue if elements else None
        launches = fuse(assemble, prologue=balance, after=after, readers=readers, beside=beside)
        if not elements:
            return [self._energies.launch_balance, *self._history, *self._first, *launches]
        first = launches[0]
        assert isinstance(first, FusedKernel)
        self._energies.threads = first.shape.threads
        return launches

    def _matrix_launches(self, assemble: Sequence[DeviceLaunch]) -> Sequence[Callable[[], None]]:
        """Returns the launches that make A of the next step, for a copy."""
        return [self._energies.launch_balance, *fuse(assemble)]

    def _assemble_matrix(self) -> None:
        """Appends the assembly of A of the next step, which leaves no trace: the balance of the last step, which reads
        what touches exert, comes first, and what the assembly leaves for the balance and the solve is cleared."""
        for launch in self._matrix:
            launch()
        runtime, stream = self.gpu.cp.cuda.runtime, self.gpu.cp.cuda.get_current_stream().ptr
        for host in (self._arrays["moving"], *self._touched):
            twin = self.gpu.twin(host)
            runtime.memsetAsync(twin.data.ptr, 0, twin.nbytes, stream)

    def _one_step(self) -> None:
        """Appends a whole step to the stream."""
        for launch in self._first_launches:
            launch()
        self._finish_step()

    def _finish_step(self) -> None:
        """Appends solve, integration and epilogue."""
        if self.stages:
            self.stages.launch()
        else:
            if self._helper:
                self._helper.begin()
            (self._newton or self._contact or self._substeps or self.solver).launch()
            if self._helper:
                self._helper.end()
            if self._held:
                self._held.launch()
            assert self._integrate is not None
            self._integrate()
        if self._measured:
            self._measured.launch()

    def assemble(self) -> None:
        """Runs the first half of one step, and copies the system matrix to the host."""
        self._make_ready()
        self.open_step()
        with self._steps:
            self._begin()
            for launch in (*self._whole_assembly, *self._forces):
                launch()
            if self._contact:
                self._contact.begin()
            values = self._arrays["values"]
            values[...] = self.gpu.twin(values).get(stream=self._steps)
        self._known = self._contact.known(values) if self._contact else values

    def factor_matrix(self, body: int) -> Float64:
        """Returns the values of A as last assembled, with the contacts that a factor is to know, (blocks, 3, 3)."""
        first, last = self._ranges[body]
        start = self._arrays["row_start"]
        return cast(Float64, self._known[start[first] : start[last]])

    def restart_clock(self) -> None:
        """Has the time of the step begin anew, without its assembly, and that of the loop's thread."""
        with self._steps:
            self._begin()
        self.loop.cpu = time.thread_time()

    def solve(self) -> None:
        """Runs the second half: solve, integration, records."""
        self._factor_upload.settle()
        self.renew_mail()
        if self._second_half:  # with branches, which only graphs have
            self._second_half.launch(self._steps)
        else:
            with self._steps:
                self._finish_step()
        self.close_step()

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def settings(self, body: int) -> DeviceSettings:
        """Returns the solver settings of a body."""
        row = self.solver.bodies[body : body + 1].reshape(())
        return DeviceSettings(row, self.mailboxes[body])

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Builds the inverse of a factor beside the steps; it is used from the first batch after its completion on."""
        self._factor_upload.post(body, pattern, values, step)

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Posts factors of different bodies, one of each; inverses of many are built beside the caller."""
        self._factor_upload.post_many(
            [(body, f.pattern, f.values, f.step) for body, f in zip(bodies, factors, strict=True)]
        )

    def prepare_for_factors(self) -> None:
        """Has the kernels that build inverses of factors compiled beside the caller, and the inverses planned whose
        patterns are known from earlier runs."""
        self.solver.compile_builder()
        self._patterns.plan()

    def prepare_factor(self, body: int, factor: Factor, r: Float64) -> Callable[[], Float64 | None]:
        """Builds the inverse of a factor beside caller and steps, and applies it to r; returns what waits for that."""
        coming = self._factor_upload.prepare(body, factor.pattern, factor.values, factor.step, r)

        def applied() -> Float64 | None:
            try:
                found = coming.result(PREPARED_WITHIN)
            except TimeoutError:  # a factor before it waits for a step, as in a pause
                return None
            return found.result() if found is not None else None

        return applied

    def may_prepare(self, body: int) -> bool:
        """False while the factor before waits to be used, or steps under way still read the one that it replaced."""
        return self._factor_upload.may_prepare(body)

    def drop_factor(self, body: int, factor: Factor) -> None:
        """Gives up a factor that may have been prepared, and is not posted."""
        self._factor_upload.drop(body, factor.values)

    def factor_memory(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Makes an array for values of a factor, from which the device copies them."""
        return pinned_array(self.gpu.cp, count, dtype)

    def shared_memory(self) -> SharedDeviceMemory:
        """Returns device memory that workers beside this process can open."""
        return SharedDeviceMemory(self.gpu)

    def expect_factors(self, body: int, pattern: FactorPattern) -> None:
        """Begins to plan the inverses of factors of a pattern that will come, and to take memory for such factors,
        beside the caller."""
        self._factor_upload.expect(body, pattern)
        if pattern.id not in self._expected and MEMORY_AHEAD[0] <= 4 * pattern.nonzeros <= MEMORY_AHEAD[1]:
            self._expected[pattern.id] = self.solver.beside(partial(self._take_memory, pattern.nonzeros))
        self._patterns.note(body, pattern)

    def _take_memory(self, count: int) -> None:
        """Has page-locked memory for factors of so many values in CuPy's pool, as many as are there at a time. While it
        is made all calls to CUDA wait."""
        together = [self.factor_memory(count, np.dtype(np.float32)) for _ in range(AT_A_TIME)]
        del together

    def expects_factors(self) -> bool:
        """True once the inverses of all factors that are expected are planned, and their memory is there."""
        return self.solver.plans_made and all(each.done() for each in self._expected.values())

    def resume_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Posts the factor that was in use when the state was saved."""
        self._factor_upload.post(body, pattern, values, step)

    @property
    def substeps(self) -> int:
        """Explicit substeps of the first step; 0: an implicit scheme, or not known yet. Those of later ones are in the
        records."""
        return self._substeps.first if self._substeps else 0

    def settle_factors(self) -> None:
        """Blocks until the next solve will use the posted factors (deterministic policies)."""
        self._factor_upload.settle()

    def factor_step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        return self._factor_upload.step(body)

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes of the inverse that one application reads."""
        return self.solver.factor_bytes(body)

    def correct(
        self, body: int, nodes: int, diagonal: Float64, double: bool = False, block: Float64 | None = None
    ) -> None:
        """Not on a GPU (Capability.LOW_RANK_UPDATE), whose solver corrects factors by itself (correction.py)."""
        raise NotImplementedError

    def replace(self, launch: int, new: Launch) -> Mail:
        """Replaces the arguments of a mailed launch from the next batch on.

        Its first step is the one after the result's `taken` steps, once that is not below 0.
        """
        self.gpu.cp.cuda.get_current_stream().synchronize()  # its arrays are complete
        return self.mailboxes[self._mailed[launch]].post(cast(DeviceLaunch, new).params.tobytes(), keep=new)

    def stage(self, changes: Sequence[ArrayChange]) -> list[Staged | None]:
        """Copies new contents to the device beside the arrays; None: no kernel has the array.

        Arrays of the host have them at once.
        """
        twins = [(self.gpu.known_twin(host), contents) for host, contents in changes]
        staged = [None if twin is None else Staged.of(self.gpu, [(twin, new)]) for twin, new in twins]
        if self._splits and (followed := self._splits.stage(changes)):
            rows = next(k for k, (host, _) in enumerate(changes) if host is self._arrays["row_start"])
            own = cast(Staged, staged[rows])
            staged[rows] = Staged([*own.copies, *followed.copies], (own.keep, followed.keep), followed.places)
        if not self._work_graphs:
            self._prepare_changes()
        self.gpu.cp.cuda.get_current_stream().synchronize()  # what is copied is complete
        for host, contents in changes:
            host[...] = contents
        return staged

    def _prepare_changes(self) -> None:
        """Captures what is launched before and after the copies of a change, in a stream of its own: steps are under
        way."""
        cp = self.gpu.cp
        self._energies.prepare_work()
        self._estimate_now = cp.asarray(np.array([ESTIMATE_EVERY], np.int32))
        stream = cp.cuda.Stream(non_blocking=True)
        graphs = []
        for after in (False, True):
            with stream:
                stream.begin_capture()
                if after and self._splits:
                    self._splits.launch()
                self._energies.launch_work(after)
                graphs.append(stream.end_capture())
        self._work_graphs = graphs

    def change(self, changes: Sequence[Staged | None]) -> DeviceChanges:
        """Copies new contents into the twins of arrays between two batches: those after the result's `taken` steps."""
        made = [each for each in changes if each is not None]
        copies = [copy for each in made for copy in each.copies]
        places = next((each.places for each in made if each.places is not None), None)
        if self._substeps:
            copies.append((self._substeps.since, int(self._estimate_now.data.ptr), 4))
        before, after = (int(graph.graphExec) for graph in self._work_graphs)
        return self._changes.post(copies, before, after, (changes, self._estimate_now), places)

    def take_changes(self) -> None:
        """Copies what waits at once, while the loop stands still."""
        cpu = self.loop.cpu  # of the loop's thread, which may be another
        super().take_changes()
        self._steps.synchronize()
        self.loop.cpu = cpu

    def withdraw_changes(self) -> bool:
        """Takes back what `change` was given last and the loop has not taken up; False if there is nothing."""
        return self._changes.withdraw()

    def records_and_reactions(self) -> tuple[NDArray[Any], Float64]:
        """Returns the records since the last call, oldest first, and reactions of obstacles (Reports); also begins to
        build inverses that were queued."""
        self._factor_upload.advance()
        if self._ties:
            self._ties.broken[:] = self._broken
        return super().records_and_reactions()
