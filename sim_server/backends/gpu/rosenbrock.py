# SPDX-License-Identifier: MIT
"""The Rosenbrock-W step on a GPU (stages.cuh): its memory and its launches.

The first attempt is made by the factor alone where the scene allows it. A body without a factor, or whose factor does
not do, iterates, in a branch of the graph. Where a body has no fixed nodes one more launch ends the step (momentum.cu).
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.base import CutInput, Launch
from sim_server.backends.declarations import Declarations
from sim_server.backends.energies import Energies
from sim_server.backends.euler_form import EulerForm
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, processors
from sim_server.backends.gpu.kernel_fusion import Epilogue, FusedKernel, PhaseGuard, block_shape, fuse
from sim_server.backends.gpu.momentum import FreeMomenta
from sim_server.backends.gpu.newton import bodies_of
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_array
from sim_server.backends.gpu.structs import STAGE_SOLVE, STAGE_STATE
from sim_server.backends.rosenbrock import FORMS, Rosenbrock
from sim_server.backends.state import StateArray, same_body

DECISION = Declarations("backends/gpu/stage_decision.cu")
STAGE_DECISION = DECISION.dtype("StageDecision")
ATTEMPTS = 5  # solves in the graph of a step: two by factors, two by iterations, one of backward Euler
FACTOR, ITERATE, EULER = (FORMS[name] for name in ("FACTOR", "ITERATE", "EULER"))

Launchable = FusedKernel | DeviceLaunch


class Branches(Protocol):
    """A device whose graphs have branches (cuda.CudaDevice)."""

    def branch(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs only if `flag` (1,) is not 0."""
        ...


class RosenbrockStep:
    """Launches a step whose first stage is assembled: solves, attempts, decisions, and the end of the step.

    stages: launches and arrays of the stages
    euler: those of steps of backward Euler
    assemble: launches of the first stage
    end: arguments of the end of the step (StepEpilogue)
    results: host memory (capacity, bodies) of STAGE_RESULT that the steps write to
    energies: arrays of the scene
    b: device array (nodes, 3) of the right-hand sides
    cut: what tells when nodes lost elements; None: no body can be cut

    alone: True if the first attempt is made by factors alone; A is then assembled only for bodies that iterate
    """

    def __init__(
        self, gpu: Gpu, device: Branches, stages: Rosenbrock, euler: EulerForm, assemble: Sequence[DeviceLaunch],
        solver: PcgSolver, end: NDArray[Any], results: NDArray[Any], energies: Energies, b: DeviceArray,
        cut: CutInput | None = None,
    ):  # fmt: skip
        cp, bodies = gpu.cp, len(stages.bound)
        self._gpu, self._device, self._stages, self._solver, self._end = gpu, device, stages, solver, end
        self._euler_form = euler
        self.alone = stages.factor_alone
        state = np.zeros(bodies, STAGE_STATE)
        state["form"], state["factor_step"], state["spring_step"] = ITERATE, -1, -1
        self._left: DeviceArray = cp.zeros(1, np.int32)
        finish = cast(DeviceLaunch, stages.finish)
        self._memory: dict[str, DeviceArray] = {
            "state": cp.asarray(np.frombuffer(state.tobytes(), np.uint8)), "phase": cp.zeros(bodies, np.int32),
            "largest": cp.zeros(bodies, np.int64), "bound": cp.asarray(stages.bound),
            "estimate": gpu.twin(stages.estimate), "body": finish.arrays["body"], "left": self._left,
        }  # fmt: skip
        self._solve_memory: dict[str, DeviceArray] = {
            "state": self._memory["state"], "phase": self._memory["phase"], "mass": gpu.twin(energies.mass),
            "share": finish.arrays["share"], "weight": finish.arrays["weight"],
            "first_stage": cp.zeros(9 * finish.items, finish.arrays["share"].dtype),
        }  # fmt: skip
        if "spring" in energies.touch:
            self._solve_memory["spring"] = gpu.twin(energies.touch["spring"])
        if cut:
            self._solve_memory["changed_at"] = gpu.twin(cut.changed_at)
        self._results, self._nodes = results, finish.items
        self._coefficients = gpu.twin(euler.coefficients)
        pairs = (euler.coefficients, np.array(euler.euler_coefficients))
        self._own_pair, self._euler_pair = (cp.asarray(pair.astype(self._coefficients.dtype)) for pair in pairs)
        self._bodies: list[DeviceArray | None] = []  # of the items of each guarded kernel
        items = block_shape("elements", finish.items, processors()).threads
        self._free = FreeMomenta(gpu, stages, energies, b, items) if stages.unheld.any() else None
        self._make_kernels(assemble)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        state, bodies = self._memory["state"], len(self._stages.bound)
        return [device_array("engine.stages", state, same_body, resets=True, bodies=bodies)]

    def _make_kernels(self, assemble: Sequence[DeviceLaunch]) -> None:
        stages = self._stages
        again, euler = (cast(Sequence[DeviceLaunch], x) for x in (stages.again, self._euler_form.assemble))
        self._again = fuse(again)
        self._second = self._keeping(stages.second, guarded=False) if self._free else stages.second
        self._first_finish = self._finish(stages.finish, FACTOR if self.alone else ITERATE, guarded=False)
        self._euler = fuse(euler, self._guard)
        self._back = self._nodal(self._euler_form.restore)
        self._advance = self._finish(self._euler_form.advance, EULER)
        if not self.alone:
            return
        self._restore = self._nodal(stages.restore)
        self._assemble = fuse([*assemble, cast(DeviceLaunch, stages.remember)], self._guard)
        self._guarded_again = fuse(again, self._guard)
        self._guarded_second = self._keeping(stages.second)
        self._guarded_finish = self._finish(stages.finish, ITERATE)

    @property
    def stamp_begin(self) -> Callable[..., None]:
        """The kernel that writes the time at which the step begins."""
        return self._first_finish.function("stamp_begin")

    def _guard(self, group: Sequence[DeviceLaunch]) -> PhaseGuard:
        parts = {**self._stages.parts, **self._euler_form.parts}
        body = bodies_of([parts[id(launch)] for launch in group if not launch.mailed])
        self._bodies.append(None if body is None else self._gpu.cp.asarray(body))
        address = 0 if self._bodies[-1] is None else self._bodies[-1].data.ptr
        return PhaseGuard(self._left.data.ptr, self._memory["phase"].data.ptr, address)

    def _nodal(self, launch: Launch, epilogue: Epilogue | None = None, guarded: bool = True) -> FusedKernel:
        """Returns the kernel of a nodal launch; guarded: for bodies whose step is not made."""
        group = [cast(DeviceLaunch, launch)]
        return FusedKernel(group, epilogue, guard=self._guard(group) if guarded else None, exact=guarded)

    def _finish(self, launch: Launch, attempt: int, guarded: bool = True) -> FusedKernel:
        """Returns the kernel that ends an attempt, with the decision."""
        params = self._decision(attempt)
        if self._free:
            return self._nodal(launch, self._free.epilogue("sum_and_decide", params), guarded)
        return self._nodal(launch, Epilogue(DECISION.checked(), "StageDecision", "decide", params, reads=True), guarded)

    def _keeping(self, launch: Launch, guarded: bool = True) -> FusedKernel:
        """Returns the kernel `second`, which keeps the forces of the first stage where a body may be free."""
        epilogue = self._free.epilogue("keep_forces", self._decision(ITERATE)) if self._free else None
        return self._nodal(launch, epilogue, guarded)

    def _decision(self, attempt: int) -> NDArray[Any]:
        """Returns the arguments of the decision."""
        params = np.zeros((), STAGE_DECISION)
        params["end"] = self._end
        for name, array in self._memory.items():
            params[name] = array.data.ptr
        params["rows"], params["results"] = self._solver.bodies_device, self._results.ctypes.data
        params["attempt"], params["nodes"] = attempt, self._nodes
        return params

    def solve_arguments(self, form: int, first_of_step: bool = False, first_of_attempt: bool = False) -> NDArray[Any]:
        """Returns the arguments of a solve."""
        stage = np.zeros((), STAGE_SOLVE)
        for name, array in self._solve_memory.items():
            stage[name] = array.data.ptr
        stage["clock"] = self._end["clock"]
        stage["form"], stage["first_of_step"], stage["first_of_attempt"] = form, first_of_step, first_of_attempt
        return stage

    def launch(self) -> None:
        """Appends the step after the assembly of its first stage, while a graph is captured."""
        if self.alone:
            self._solver.apply_factors(0, self.solve_arguments(FACTOR, first_of_step=True, first_of_attempt=True))
            _launch(self._second, *self._again)
            self._solver.apply_factors(1, self.solve_arguments(FACTOR))
            self._first_finish()
            with self._device.branch(self._left):
                _launch(self._restore, *self._assemble)
                self._iterate(False, self._guarded_second, self._guarded_again, self._guarded_finish)
        else:
            self._iterate(True, self._second, self._again, self._first_finish)
        if self._free:
            self._free.launch(self._first_finish.function("set_momenta"), self._decision(EULER))

    def _iterate(
        self, first_of_step: bool, second: Launch | FusedKernel, again: Sequence[Launchable], finish: FusedKernel
    ) -> None:
        """Appends an attempt by iterations, and the branch of backward Euler."""
        self._solver.iterate(2, self.solve_arguments(ITERATE, first_of_step, first_of_attempt=True))
        _launch(second, *again)
        self._solver.iterate(3, self.solve_arguments(ITERATE))
        finish()
        with self._device.branch(self._left):
            self._back()
            self._set_coefficients(self._euler_pair)
            _launch(*self._euler)
            self._solver.iterate(4, self.solve_arguments(EULER, first_of_attempt=True))
            self._set_coefficients(self._own_pair)
            self._advance()

    def _set_coefficients(self, pair: DeviceArray) -> None:
        """Sets the coefficients of launches whose arguments change while steps run."""
        runtime, stream = self._gpu.cp.cuda.runtime, self._gpu.cp.cuda.get_current_stream().ptr
        to = self._coefficients
        runtime.memcpyAsync(to.data.ptr, pair.data.ptr, to.nbytes, runtime.memcpyDeviceToDevice, stream)


def _launch(*launches: Launch | FusedKernel) -> None:
    for launch in launches:
        launch()
