# SPDX-License-Identifier: MIT
"""The sequence of launches that make a step on a GPU: assembly, solve, integration, and the end of the step."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.base import EngineInput
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.central_difference import SubstepLoop
from sim_server.backends.gpu.contact import ContactPasses
from sim_server.backends.gpu.correction import FactorCorrection
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.energies import DeviceEnergies
from sim_server.backends.gpu.held import HeldForces
from sim_server.backends.gpu.helper import Helper
from sim_server.backends.gpu.host_results import HostResults
from sim_server.backends.gpu.kernel_fusion import DOMAINS, Epilogue, FusedKernel, Prologue, fuse
from sim_server.backends.gpu.loop import CAPACITY
from sim_server.backends.gpu.measured import MeasuredReport
from sim_server.backends.gpu.newton import NewtonIteration, NewtonPhases, begins_beside
from sim_server.backends.gpu.rosenbrock import ATTEMPTS, RosenbrockStep
from sim_server.backends.gpu.smoothing import FactorSmoothing
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.solver_features import SolverFeatures
from sim_server.backends.gpu.splits import DeviceSplits
from sim_server.backends.gpu.state import device_array, device_arrays
from sim_server.backends.gpu.step_launches import StepLaunches
from sim_server.backends.newton import Newton
from sim_server.backends.state import StateArray

EPILOGUE = Declarations("backends/gpu/step_epilogue.cu")
STEP_EPILOGUE = EPILOGUE.dtype("StepEpilogue")
PLANES = {"float16": 1, "float32": 2}  # float16 numbers per entry of an inverse

Launchable = Callable[[], None]


class StepSequence:
    """Launches of a step, which are appended to the current stream.

    given: input from the scene
    results: memory of the host that the steps write to

    counter: device array (1,), completed steps
    energies, solver, splits, stages, newton, contact, substeps: what the step is made of; None: the scene has no such
        part
    stamp_begin: kernel that writes the time at which a step begins
    """

    def __init__(self, gpu: Gpu, device: CudaDevice, given: EngineInput, results: HostResults):
        self._gpu, self._device, self._given, self._results = gpu, device, given, results
        self._launches, self._helper = StepLaunches.of(given), Helper.wanted(gpu, given)
        self.counter: DeviceArray = gpu.cp.zeros(1, np.int64)
        self.energies = DeviceEnergies(gpu, given.energies, CAPACITY, self.counter, given.dt)
        errors = given.errors or self._budgets
        search = begins_beside(self._launches.assembly, given.ranges, errors) if given.newton else None
        self._fuse_assembly(search)
        phases = NewtonPhases.initial(gpu, len(given.ranges)) if given.newton else None
        self._correction = FactorCorrection.wanted(gpu, given)
        self._smoothing = None if self._helper else FactorSmoothing.wanted(gpu, given)  # which has half of the inverse
        features = self._features(phases, errors)
        self.solver = PcgSolver(gpu, given.ranges, given.arrays, self.counter, CAPACITY, features)
        self.newton = self._newton_iteration(phases, search) if phases else None
        has_splits = bool(given.cut and given.cut.most_blocks)
        self.splits = DeviceSplits(gpu, given, self.solver, self.newton, self.counter) if has_splits else None
        self.contact = self._contact_passes() if given.contact else None
        self.substeps = self._substep_loop() if given.substeps else None
        self._held = self._held_forces() if given.held is not None else None
        self._measured = self._measured_report() if given.measured else None
        self._epilogue = self._epilogue_params()
        self.stages = self._rosenbrock_step() if given.stages else None
        self._integration = None if self.stages else self._fused_integration()
        self.stamp_begin = self._stamp()

    # --- parts --------------------------------------------------------------------------------------------------

    @property
    def _budgets(self) -> bool:
        """Whether solves may end by their wall time."""
        solver = self._given.solver
        return bool(solver.budget or solver.step_budget)

    @property
    def _factor_alone(self) -> bool:
        """Whether steps are made by factors alone, as long as these do."""
        stages = self._given.stages
        return stages is not None and stages.factor_alone

    def _fuse_assembly(self, search: Prologue | None) -> None:
        """Fuses the launches before the solve. search: begins the Newton iteration beside the last of them"""
        launches, stages = self._launches, self._given.stages
        others = [launch for launch in launches.assembly if launch not in launches.detection]
        self._whole_assembly = self._beginning(others, launches.detection, launches.settled, search)
        self._assembly, self._forces = self._whole_assembly, list[Launchable]()
        self._matrix: Sequence[Launchable] = ()
        if stages and self._factor_alone:
            forces = cast(Sequence[DeviceLaunch], stages.first)
            self._assembly = self._beginning(forces)
            self._forces = list(fuse(forces))  # after a whole assembly, whose energy balance is made already
            self._matrix = [self.energies.launch_balance, *fuse(launches.assembly)]

    def _beginning(
        self, assembly: Sequence[DeviceLaunch], after: Sequence[DeviceLaunch] = (),
        readers: Sequence[DeviceLaunch] = (), beside: Prologue | None = None,
    ) -> Sequence[Launchable]:  # fmt: skip
        """Fuses the assembly with the energy balance of the step before. after: launches that follow, one by one.
        readers: later ones that read what it makes. beside: done beside its last kernel.

        The balance is the prologue of a kernel over elements, since these write nothing that it reads. If it freezes a
        body meanwhile, the element results of this body do not matter, since its nodes are fixed then. What advances
        the history of materials comes after the balance: a frozen body has none.
        """
        domains, before = {launch.domain for launch in assembly}, [*self._launches.history, *self._launches.first]
        elements = "elements" in domains and domains <= set(DOMAINS) and not before
        balance = self.energies.prologue if elements else None
        launches = fuse(assembly, prologue=balance, after=after, readers=readers, beside=beside)
        if not elements:
            return [self.energies.launch_balance, *before, *launches]
        first = launches[0]
        assert isinstance(first, FusedKernel)
        self.energies.threads = first.shape.threads
        return launches

    def _features(self, phases: NewtonPhases | None, errors: bool) -> SolverFeatures:
        """Returns what the solves of the scene do beside the plain iteration."""
        given, precision = self._given, self._given.solver.factor_precision
        if precision == "auto" and self._factor_alone:
            precision = "float32"
        return SolverFeatures(
            planes=PLANES.get(precision),
            phases=phases.of_solves(errors) if phases else (),
            attempts=ATTEMPTS if given.stages else 0,
            contact=given.contact is not None,
            between=given.contact is not None and bool(given.contact.surfaces or given.contact.ties),
            correction=self._correction,
            errors=errors,
            budgets=self._budgets,
            cut=given.cut,
            smoothing=self._smoothing,
            helper=self._helper,
        )

    def _newton_iteration(self, phases: NewtonPhases, search: Prologue | None) -> NewtonIteration:
        given, newton, launches = self._given, self._given.newton, self._launches
        assert newton is not None and self._results.newton is not None
        repeated = newton.parts[len(launches.first) :]
        return NewtonIteration(
            self._gpu, self._device, Newton(newton.options, newton.dx_dv, repeated, newton.detect, **newton.arrays),
            launches.assembly, given.ranges, given.arrays, phases, self.solver, self._results.newton, launches.settled,
            search, within=given.held is None,
        )  # fmt: skip

    def _contact_passes(self) -> ContactPasses:
        """Returns the solves with contact; detection that is no launch of an effect ends the assembly."""
        given, results = self._given, self._results.contact
        assert given.contact is not None and results is not None
        passes = ContactPasses(
            self._gpu, self._device, given.contact, given.ranges, given.arrays, self.solver, self.energies.balance,
            results, self._correction,
        )  # fmt: skip
        if passes.detects:
            self._assembly = self._whole_assembly = [*self._whole_assembly, passes.detect]
        return passes

    def _substep_loop(self) -> SubstepLoop:
        given, results, launches = self._given, self._results.substeps, self._launches
        assert given.substeps is not None and results is not None
        return SubstepLoop(
            self._gpu, self._device, given.substeps, launches.substep_forces, launches.settled, self.solver,
            self.energies.params, given.dt, results,
        )  # fmt: skip

    def _held_forces(self) -> HeldForces:
        reaction, results = self._given.held, self._results.held
        assert reaction is not None and results is not None
        return HeldForces(self._gpu, self._launches.settled, reaction, results, self.counter)

    def _measured_report(self) -> MeasuredReport:
        assert self._results.measured is not None
        return MeasuredReport(self._gpu, self._given.measured, self._results.measured, self.counter)

    def _epilogue_params(self) -> NDArray[Any]:
        """Returns the arguments of step_epilogue.cu."""
        params, arrays, solver = np.zeros((), STEP_EPILOGUE), self._given.arrays, self.solver
        self._finished_blocks: DeviceArray = self._gpu.cp.zeros(1, np.uint32)
        memory = {
            "clock": self._gpu.twin(arrays["clock"]), "step": self.counter, "pool_counters": solver.pool_counter,
            "finished_blocks": self._finished_blocks, "moving": self._gpu.twin(arrays["moving"]),
            "begun": solver.begun,
        }  # fmt: skip
        for name, array in memory.items():
            params[name] = array.data.ptr
        params["timestamps"] = self._results.timestamps.ctypes.data
        params["dt"], params["counters"], params["capacity"] = self._given.dt, len(solver.pool_counter), CAPACITY
        params["bodies"] = len(self._given.ranges)
        return params

    def _rosenbrock_step(self) -> RosenbrockStep:
        given, results = self._given, self._results.stages
        assert given.stages is not None and given.euler is not None and results is not None
        return RosenbrockStep(
            self._gpu, self._device, given.stages, given.euler, self._launches.assembly, self.solver, self._epilogue,
            results, given.energies, self._gpu.twin(given.arrays["b"]), given.cut,
        )  # fmt: skip

    def _fused_integration(self) -> FusedKernel:
        """Returns the kernel that moves nodes and ends the step."""
        launches = [self.substeps.close] if self.substeps else self._launches.integration
        epilogue = Epilogue(EPILOGUE.checked(), "StepEpilogue", "finish_step", self._epilogue)
        return FusedKernel(launches, epilogue, opening=self.newton.ending() if self.newton else None)

    def _stamp(self) -> Callable[..., None]:
        if self.stages:
            return self.stages.stamp_begin
        assert self._integration is not None
        return self._integration.function("stamp_begin")

    # --- launches -----------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Appends the kernel that writes the time at which the step begins, for an idle device."""
        self.stamp_begin((1,), (1,), (self._epilogue,))

    def launch(self) -> None:
        """Appends a whole step."""
        for launch in self._assembly:
            launch()
        self.finish()

    def finish(self) -> None:
        """Appends solve, integration and epilogue."""
        if self.stages:
            self.stages.launch()
        else:
            self._solve()
            if self._held:
                self._held.launch()
            assert self._integration is not None
            self._integration()
        if self._measured:
            self._measured.launch()

    def _solve(self) -> None:
        if self._helper:
            self._helper.begin()
        (self.newton or self.contact or self.substeps or self.solver).launch()
        if self._helper:
            self._helper.end()

    @property
    def branches(self) -> bool:
        """Whether `finish` has branches or loops, which only graphs have."""
        return bool(self.stages or self.contact or self.substeps or (self.newton and self.newton.loops))

    def assemble(self) -> None:
        """Appends the first half of a step, with A, however steps are made."""
        self.begin()
        for launch in (*self._whole_assembly, *self._forces):
            launch()
        if self.contact:
            self.contact.begin()

    @property
    def makes_matrix_apart(self) -> bool:
        """Whether steps make no A, so that a copy of it needs `assemble_matrix`."""
        return bool(self._matrix)

    def assemble_matrix(self) -> None:
        """Appends the assembly of A of the next step, which leaves no trace: the balance of the last step, which reads
        what touches exert, comes first, and what the assembly leaves for the balance and the solve is cleared."""
        for launch in self._matrix:
            launch()
        runtime, stream = self._gpu.cp.cuda.runtime, self._gpu.cp.cuda.get_current_stream().ptr
        touch = self._given.energies.touch
        for host in (self._given.arrays["moving"], *(touch[name] for name in ("force", "spring") if name in touch)):
            twin = self._gpu.twin(host)
            runtime.memsetAsync(twin.data.ptr, 0, twin.nbytes, stream)

    def known(self, values: Float64) -> Float64:
        """Returns values of A, as the assembly has made them, with the contacts that a factor is to know."""
        return self.contact.known(values) if self.contact else values

    # --- state --------------------------------------------------------------------------------------------------

    def state(self) -> list[StateArray]:
        """Returns what the device carries on beside the arrays that launches write."""
        solves = self._correction, self._smoothing
        parts = (self.energies, self.stages, self.substeps, self.contact, *solves, self.splits)
        clock, contact = self._gpu.twin(self._given.arrays["clock"]), self._given.contact
        found = [device_array("engine.clock", clock), *(a for part in parts if part for a in part.state())]
        if contact and contact.surfaces:
            names = ("corner", "weight")
            rows = {name: getattr(contact, name) for name in names}
            twins = {name: self._gpu.twin(array, dtype=array.dtype) for name, array in rows.items()}
            found += device_arrays("engine.contact", twins, *names)
        return found
