# SPDX-License-Identifier: MIT
"""Explicit substeps on a GPU: all of a step in one launch of its graph.

A loop of the graph has rounds of ROUND substeps, of two kernels each where the effects have one kind of elements: one
over elements, one over nodes, which gathers, adds what acts on nodes and moves them. Before a round in which an
estimate of the stable step is due a branch makes it (central_difference.cu).
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.central_difference import CentralDifference
from sim_server.backends.cpu.structs import STABLE_STEP
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import FusedKernel, PhaseGuard, fuse
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.state import StateArray

TEXT = Declarations("backends/gpu/central_difference.cu")
SUBSTEPS, SUBSTEP_STATE = TEXT.dtype("Substeps"), TEXT.dtype("SubstepState")
THREADS: int = 128  # of a thread block: 32 WARPS of energy_balance.cu
ROUND = 4  # substeps between two decisions
FIRST_ITERATIONS: int = TEXT.constant("FIRST_ITERATIONS")
ESTIMATE_EVERY: int = TEXT.constant("ESTIMATE_EVERY")
MOST_SUBSTEPS: int = TEXT.constant("MOST_SUBSTEPS")
SAFETY: float = TEXT.constant("SAFETY")


class Branches(Protocol):
    """A device whose graphs have branches and loops (cuda.CudaDevice)."""

    def branch(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs only if `flag` (1,) is not 0."""
        ...

    def repeat(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs as long as `flag` (1,) is not 0."""
        ...


class SubstepLoop:
    """Launches the substeps of a step.

    given: launches and arrays of the substeps
    forces: launches that evaluate the forces
    readers: launches after the substeps
    energy: arguments of the energy balance (EnergyBalance)
    results: host memory (capacity, bodies) of SUBSTEP_RESULT that the steps write to

    first: substeps of the first step; 0: not known yet
    """

    def __init__(
        self, gpu: Gpu, device: Branches, given: CentralDifference, forces: Sequence[DeviceLaunch],
        readers: Sequence[DeviceLaunch], solver: PcgSolver, energy: NDArray[Any], dt: float, results: NDArray[Any],
    ):  # fmt: skip
        cp, self._device, self._given = gpu.cp, device, given
        self._dt, self.first = dt, 0
        self._bodies = len(given.amplitude)
        self.close = cast(DeviceLaunch, given.close)
        others = [cast(DeviceLaunch, launch) for launch in given.launches]
        kick, rest = cast(DeviceLaunch, given.kick), [x for x in others if x is not given.kick]
        self._forces = fuse(forces, readers=[*others, *readers])
        self._substep = fuse([*forces, kick], readers=[*rest, *readers])
        stable, state = np.zeros(self._bodies, STABLE_STEP), np.zeros(1, SUBSTEP_STATE)
        given.set_bodies(stable)
        state["round"] = ROUND
        flags = {name: cp.zeros(1, np.int32) for name in ("due", "runs", "opens")}
        self._flags: dict[str, DeviceArray] = flags
        self._memory: dict[str, DeviceArray] = {
            "state": cp.asarray(state.view(np.uint8)), "stable": cp.asarray(stable.view(np.uint8)),
            "away": cp.zeros(self._bodies, np.int32), "finished": cp.zeros(1, np.uint32), **flags,
        }  # fmt: skip
        for name in ("force", "mode", "kept_x", "kept_force", "substep", "shift_time", "failed"):
            self._memory[name] = gpu.twin(getattr(given, name))
        self._params = np.zeros((), SUBSTEPS)
        self._params["energy"], self._params["dt"] = energy, dt
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        self._params["results"], self._params["told"] = solver.results.data.ptr, results.ctypes.data
        guard = PhaseGuard(flags["opens"].data.ptr, 0, 0)
        self._open = FusedKernel([cast(DeviceLaunch, given.open)], guard=guard)
        flags_of_compiler = (*options(gpu.types), *own_headers())
        module = cp.RawModule(code=TEXT.checked(), options=flags_of_compiler, backend="nvrtc")
        names = ("measure_frequency", "begin_substeps", "shorten_substeps", "end_round")
        self._kernels: dict[str, KernelFunction] = {n: compiled("central_difference.cu", module, n) for n in names}

    @property
    def since(self) -> int:
        """Device address of the number of substeps since the last estimate of the stable step."""
        dtype, _offset = cast(dict[str, Any], SUBSTEP_STATE.fields)["since"][:2]
        assert dtype == np.int32
        return int(self._memory["state"].data.ptr) + int(_offset)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on: the estimate of the stable substep."""
        return device_arrays("engine.substeps", self._memory, "state", "stable", "mode")

    def start(self) -> None:
        """Estimates the stable step before the first step."""
        _run(self._forces)
        self._given.keep()
        for k in range(FIRST_ITERATIONS):
            self._iterate(k)
        stable = self._memory["stable"].get().view(STABLE_STEP)
        omega = float(stable["omega"].max(initial=0.0))
        self.first = min(int(np.ceil(self._dt * omega / (2 * SAFETY))), MOST_SUBSTEPS)  # a few less than with damping

    def launch(self) -> None:
        """Appends a step, but for its end, while a graph is captured."""
        self._given.remember()
        self._kernels["begin_substeps"]((1,), (THREADS,), (self._params,))
        with self._device.repeat(self._flags["runs"]):
            self._open()
            with self._device.branch(self._flags["due"]):
                _run(self._forces)
                self._given.keep()
                self._iterate(FIRST_ITERATIONS)
                self._kernels["shorten_substeps"]((1,), (THREADS,), (self._params,))
                self._given.shift()
            for _ in range(ROUND):
                _run(self._substep)
            self._kernels["end_round"]((self._bodies,), (THREADS,), (self._params,))

    def _iterate(self, k: int) -> None:
        """Appends iteration k of the estimate of the stable step, at x with the forces there."""
        self._given.displace()
        _run(self._forces)
        self._kernels["measure_frequency"]((self._bodies,), (THREADS,), (self._params, np.int32(k)))


def _run(launches: Sequence[Any]) -> None:
    for launch in launches:
        launch()
