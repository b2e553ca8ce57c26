# SPDX-License-Identifier: MIT
"""The simulation loop on a GPU: the same face as engine.Engine, on one CUDA graph per step.

A step is a graph of the scene's launches with the persistent solver among them; the stop test of the iteration is on
the device, so the native loop (loop.cpp) only launches graphs, moves mail and reads results. What is here captures the
graphs and puts settings, factors, arguments and requests into mailboxes.
"""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.base import Capability, EngineInput, Launch
from sim_server.backends.compiler import HERE
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.energies import DeviceEnergies
from sim_server.backends.gpu.factor_upload import FactorUpload
from sim_server.backends.gpu.kernel_fusion import DOMAINS, Epilogue, FusedKernel, domain, fused
from sim_server.backends.gpu.loop import CAPACITY, MANY, DeviceLoop
from sim_server.backends.gpu.mailbox import DeviceMailbox
from sim_server.backends.gpu.newton import NewtonIteration, NewtonPhases
from sim_server.backends.gpu.solver import PCG_BODY, PCG_RESULT, SETTINGS_BYTES, PcgSolver
from sim_server.backends.gpu.structs import ENERGY_RECORD, NEWTON_RESULT, STEP_TIMESTAMP, Mail

FEW = 16  # trials in a step up to which MANY steps make one graph
STEP_EPILOGUE = np.dtype(
    [
        ("clock", "u8"), ("step", "u8"), ("dt", "f8"), ("pool_counters", "u8"), ("finished_blocks", "u8"),
        ("timestamps", "u8"), ("results", "u8"), ("host_results", "u8"), ("moving", "u8"), ("counters", "i4"),
        ("capacity", "i4"), ("result_words", "i4"), ("bodies", "i4"),
    ]
)  # fmt: skip


class DeviceSettings:
    """Solver settings of a body; what is set holds from its next batch on."""

    def __init__(self, row: NDArray[Any], mailbox: DeviceMailbox):
        object.__setattr__(self, "_row", row)
        object.__setattr__(self, "_mailbox", mailbox)

    def __getattr__(self, name: str) -> Any:
        return self._row[name].item()

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("budget", "omega") or self._row[name] == value:  # no budget of wall time and no SSOR on a GPU
            return
        self._row[name] = value
        self._mailbox.post(self._row.tobytes()[:SETTINGS_BYTES])


class GpuEngine(DeviceLoop):
    """The loop over one system. records: number of them that the ring holds. Raises what Gpu.building translates."""

    capabilities: frozenset[Capability] = frozenset()

    def __init__(self, gpu: Gpu, given: EngineInput, records: int = 8192):
        assemble, integrate = (cast(Sequence[DeviceLaunch], part) for part in (given.assemble, given.integrate))
        ranges, arrays, dt, newton = given.ranges, given.arrays, given.dt, given.newton
        planes = 2 if given.solver.factor_precision == "float32" else 1  # float16 numbers that make one of a factor
        self.gpu, self.launches, self._arrays = gpu, [*assemble, *integrate], arrays
        cp, bodies = gpu.cp, len(ranges)
        device = CudaDevice(cp)
        self._steps = device.steps
        self._counter = cp.zeros(1, np.int64)
        self._stamps = device.pinned(CAPACITY * STEP_TIMESTAMP.itemsize)
        self._results = device.pinned(CAPACITY * PCG_RESULT.itemsize * bodies)
        told = device.pinned(CAPACITY * ENERGY_RECORD.itemsize * bodies)
        self._energies = DeviceEnergies(gpu, given.energies, told, self._counter, dt)
        self._fused = self._beginning(assemble)
        phases = NewtonPhases.of(gpu, bodies) if newton else None
        self.solver = PcgSolver(gpu, ranges, arrays, self._counter, CAPACITY, planes, phases or ())
        self._search, found = None, None
        if newton and phases:
            found = device.pinned(CAPACITY * NEWTON_RESULT.itemsize * bodies)
            self._search = NewtonIteration(gpu, newton, assemble, ranges, arrays, phases, self.solver, found)
        row, first = PCG_BODY.itemsize, self.solver.bodies_device
        boxes = [(first + row * k, SETTINGS_BYTES) for k in range(bodies)]
        boxes += [(first + row * k + SETTINGS_BYTES, row - SETTINGS_BYTES) for k in range(bodies)]
        self._mailed = {k: len(boxes) + i for i, k in enumerate(k for k, x in enumerate(self.launches) if x.mailed)}
        boxes += [(self.launches[k].mail_address, self.launches[k].params.nbytes) for k in self._mailed]
        twins = {name: gpu.twin(arrays[name]) for name in ("values", "x", "v")}
        addresses = {name: int(twin.data.ptr) for name, twin in twins.items()}
        if self._search:
            addresses["values"] = int(self._search.first_values.data.ptr)
        super().__init__(
            device, ranges, arrays["row_start"], dt, boxes, self._results, self._stamps, arrays["clock"],
            records, twins["values"].dtype, found, told, **addresses,
        )  # fmt: skip
        self._intake = FactorUpload(gpu, self.solver, self, given.names, self.mailboxes[bodies : 2 * bodies])
        for k in range(bodies):
            whole = self.solver.bodies[k : k + 1].tobytes()
            self.mailboxes[k].post(whole[:SETTINGS_BYTES])
            self.mailboxes[bodies + k].post(whole[SETTINGS_BYTES:])
        self.begin: Sequence[Launch] = ()  # before the first step
        self._graphs: list[Any] = []
        self._epilogue = self._end_of_step(dt)
        self._last = FusedKernel(
            integrate,
            Epilogue(
                (HERE / "backends/gpu/step_epilogue.cu").read_text(), "StepEpilogue", "finish_step", self._epilogue
            ),
        )
        self._stamp = self._last.function("stamp")
        self._capture()
        cp.cuda.get_current_stream().synchronize()  # what was made until now is there for the loop's streams

    def _end_of_step(self, dt: float) -> NDArray[Any]:
        self._finished = self.gpu.cp.zeros(1, np.uint32)
        params = np.zeros((), STEP_EPILOGUE)
        arrays = {
            "clock": self.gpu.twin(self._arrays["clock"]), "step": self._counter,
            "pool_counters": self.solver.pool_counter, "finished_blocks": self._finished,
            "results": self.solver.results, "moving": self.gpu.twin(self._arrays["moving"]),
        }  # fmt: skip
        for name, array in arrays.items():
            params[name] = array.data.ptr
        params["timestamps"], params["host_results"] = self._stamps.ctypes.data, self._results.ctypes.data
        params["dt"], params["counters"], params["capacity"] = dt, len(self.solver.pool_counter), CAPACITY
        params["result_words"], params["bodies"] = len(self._ranges) * PCG_RESULT.itemsize // 8, len(self._ranges)
        return params

    # --- running ------------------------------------------------------------------------------------------------

    def run(self, steps: int) -> int:
        self._intake.advance()
        self._make_ready()
        return super().run(steps)

    def _make_ready(self) -> None:
        """What a scheme makes of the state before the first step, and the energy that it has."""
        begins = bool(self.begin) and self.step == 0
        if begins:
            for launch in self.begin:
                launch()
        if not self._energies.started:
            self._energies.start()
            begins = True
        if begins:
            self.gpu.cp.cuda.get_current_stream().synchronize()

    def restart_energy(self) -> None:
        """Has energy reckoned from the state at the beginning of the next step: for those who have set x or v."""
        self._energies.started = False

    def _capture(self) -> None:
        many = self._search is None or self._search.rounds <= FEW
        for begin in (False, True):
            for steps in (1, MANY):
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
        others = [self._captured(self._energies.account), self._captured(self._energies.elastic)]
        handles = [int(graph.graphExec) if graph else 0 for graph in self._graphs]
        self.use_graphs(handles, *(int(graph.graphExec) for graph in others))
        self._graphs += others  # they live as long

    def _captured(self, launch: Callable[[], None]) -> Any:
        """The graph of what `launch` puts onto a stream."""
        with self._steps:
            self._steps.begin_capture()
            launch()
            return self._steps.end_capture()

    def _begin(self) -> None:
        """Notes the time: the device has had nothing to do until now."""
        self._stamp((1,), (1,), (self._epilogue,))

    def _beginning(self, assemble: Sequence[DeviceLaunch]) -> list[Callable[[], None]]:
        """What a step begins with: the account of the one before, and the assembly.

        The account is part of a kernel over elements, since such kernels write nothing that it reads. What they make of
        a body that is frozen meanwhile does not count: its nodes are fixed.
        """
        domains = {domain(launch) for launch in assemble}
        elements = "elements" in domains and domains <= set(DOMAINS)
        launches = fused(assemble, first=self._energies.prologue if elements else None)
        if not elements:
            return [self._energies.account, *launches]
        self._energies.threads = launches[0].shape.threads
        return launches

    def _one_step(self) -> None:
        """Everything a step puts onto the stream."""
        for launch in self._fused:
            launch()
        self._finish_step()

    def _finish_step(self) -> None:
        """Solve, integrate, count."""
        (self._search or self.solver).launch()
        self._last()

    def assemble(self) -> None:
        """First half of one step: the system matrix, which the host has then too."""
        self._make_ready()
        self._open()
        with self._steps:
            self._begin()
            for launch in self._fused:
                launch()
            values = self._arrays["values"]
            values[...] = self.gpu.twin(values).get(stream=self._steps)

    def solve(self) -> None:
        """Second half: solve, integrate, report."""
        self._intake.settle()
        self._renew()
        with self._steps:
            self._finish_step()
        self._close()

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def settings(self, body: int) -> DeviceSettings:
        """Solver settings of a body."""
        row = self.solver.bodies[body : body + 1].reshape(())
        return DeviceSettings(row, self.mailboxes[body])

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Has L expanded beside the steps; taken up between batches once that is done."""
        self._intake.post(body, pattern, values, step)

    def settle_factors(self) -> None:
        """Sees to it that the next solve uses what was posted: waits until it is expanded (deterministic policies)."""
        self._intake.settle()

    def factor_step(self, body: int) -> int:
        """Step of the factor in use, -1 without one."""
        return self._intake.step(body)

    def factor_bytes(self, body: int) -> int:
        """Of the inverse that an application reads."""
        return self.solver.factor_bytes(body)

    def correct(self, body: int, nodes: int, diagonal: Float64, double: bool = False) -> None:
        """Not on a GPU (Capability.LOW_RANK_UPDATE)."""
        raise NotImplementedError

    def replace(self, launch: int, new: Launch) -> Mail:
        """Gives a mailed launch other arguments, from the next batch on: its first step is the one after the result's
        `taken` steps, once it is not below 0."""
        self.gpu.cp.cuda.get_current_stream().synchronize()  # its arrays are on the device
        return self.mailboxes[self._mailed[launch]].post(cast(DeviceLaunch, new).params.tobytes(), keep=new)

    def records(self) -> NDArray[Any]:
        """New records since the last call, oldest first; also begins factors that have waited for room."""
        self._intake.advance()
        return super().records()
