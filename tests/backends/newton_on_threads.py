# SPDX-License-Identifier: MIT
"""Newton-Raphson of a GPU: its launches in their order (gpu/newton.py), the kernels of newton.cu run by threads of the
processor, assemblies by their texts as a CPU has them, linear systems solved directly or by pcg.cu."""

import ctypes as c
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import bsr_array
from scipy.sparse.linalg import spsolve

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu.device import CpuLaunch
from sim_server.backends.gpu import newton as gpu_newton
from sim_server.backends.gpu.conditions import Loop
from sim_server.backends.gpu.kernel_fusion import DOMAINS
from sim_server.backends.gpu.newton import NewtonIteration, NewtonPhases
from sim_server.backends.gpu.solver import PCG_BODY
from sim_server.backends.gpu.structs import NEWTON_RESULT, PCG, PCG_RESULT
from sim_server.backends.newton import Newton
from sim_server.simulation import Simulation
from tests.backends.fake_cupy import Array
from tests.backends.fake_graphs import Graphs
from tests.backends.pcg_on_threads import CLOCK, Solver, SolverHost

TESTS = Path(__file__).parent.parent
SOLVE = 0  # phase
TEXT = """
#include "cuda_threads.h"
#include "newton.cu"
extern "C" void cudaGraphSetConditional(unsigned long long handle, unsigned value) { *(int*)handle = value; }
#define STEP(name, threads, ...) \\
    extern "C" void name##_all(const NewtonArguments* p, int grid, int block, unsigned long long loop) { \\
        if (block != threads) std::abort(); \\
        launch(grid, threads, [&] { name(*p __VA_OPT__(,) __VA_ARGS__); }); \\
    }
STEP(begin_newton, BLOCK_NODES)
STEP(update_state, ALL_LANES, loop)
STEP(accept_trial, BLOCK_NODES, loop)
STEP(end_newton, BLOCK_NODES)
"""


JUDGING = """
#include "pcg.cu"
extern "C" void solve(const PcgArguments* s, const int* active, const int* phase, Search* search, const Correction* k) {
    *s->pool_counter = 0;
    launch_together(s->grid, THREADS, [&] { pcg(*s, active, phase, search, *k); },
                    {{&memory, sizeof memory}, {shared_memory, sizeof shared_memory},
                     {shared_vector, sizeof shared_vector}});
}
"""


def compiled(folder: Path, *defined: str) -> c.CDLL:
    """Compiles newton.cu."""
    (folder / "newton.cpp").write_text(TEXT)
    (folder / "clock.cuh").write_text(CLOCK)
    paths = [f"-I{p}" for p in (folder, TESTS / "backends", SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-Dreal=double", "-DLOOPS", "-w", *paths]
    command += [f"-D{word}" for word in defined]
    subprocess.run([*command, str(folder / "newton.cpp"), "-o", str(folder / "newton.so")], check=True)
    return c.CDLL(str(folder / "newton.so"))


class SharedHost(SolverHost):
    """Stands for a GPU that has the memory of the host."""

    def twin(self, host: NDArray[Any], dtype: Any = None) -> Array:
        return as_device(host)


def as_device(array: NDArray[Any]) -> Array:
    """The same memory as an array of a device."""
    return array.view(Array)


class Launch:
    """A launch of a CPU in a graph. name: of the kernel, noted in `ran` when it runs."""

    mailed = False

    def __init__(self, run: "OnThreads", launch: CpuLaunch):
        self._run, self._launch, self.domain = run, launch, launch.domain
        self.name = launch.name.split(".")[1]

    def with_array(self, array: Array, other: Array) -> "Launch":
        names = [name for name, mine in self._launch.arrays.items() if mine.ctypes.data == array.ctypes.data]
        given = {f.name: value for f, value in zip(self._launch.fields, self._launch.values, strict=True)}
        bound = self._launch.module.bind(self.name, **given | dict.fromkeys(names, np.asarray(other)))
        return Launch(self._run, bound)

    def __call__(self) -> None:
        solves = self.domain == "blocks"  # only bodies that are solved next need these
        self._run.put(self.name, self._launch, guarded=True, solves=solves)


class OnThreads:
    """Steps of a scene in the order of a GPU: holders move once, before the first assembly.

    loops: whether its graphs have loops. solves: library of JUDGING, where the error of positions is bounded
    blocks: thread blocks of pcg.cu. ran: names of what the last step ran, but for kernels of bodies that are done
    """

    def __init__(
        self, library: c.CDLL, sim: Simulation, monkeypatch: pytest.MonkeyPatch, loops: bool = True,
        solves: c.CDLL | None = None, blocks: int = 1,
    ):  # fmt: skip
        self.sim, self._library, s, w = sim, library, sim.system, sim.world
        self.ran: list[str] = []
        monkeypatch.setattr(gpu_newton, "fuse", lambda launches, guard, readers: list(launches))
        self._solves = solves
        self._graphs, zeros = Graphs(), lambda *shape: as_device(np.zeros(*shape))
        module = SimpleNamespace(get_function=self._kernel)
        cp = SimpleNamespace(
            zeros=zeros, asarray=lambda x: as_device(np.array(x)), empty_like=lambda x: np.full_like(x, np.nan),
            full=lambda shape, value, kind: as_device(np.full(shape, value, kind)), RawModule=lambda **_: module,
        )  # fmt: skip
        self._gpu: Any = SimpleNamespace(cp=cp, twin=as_device, types={"real": "double", "local": "double"})
        assemble, self._integrate = sim.launches()
        self._held = [x for x in assemble if x.domain not in DOMAINS]
        self._assemble, bodies = assemble[len(self._held) :], len(w.bodies)
        newton = sim.integrator.newton(assemble, slice(0, 0), list(sim.effects.values()))
        assert newton is not None
        newton = Newton(newton.options, newton.dx_dv, newton.parts[len(self._held) :], newton.detect, **newton.arrays)
        self.phases = NewtonPhases.initial(self._gpu, bodies)
        if solves:
            self.pcg = Solver(sim, monkeypatch, 0, blocks, SharedHost(), self.phases.of_solves(True))
            own = self.pcg.solver
            self.results, rows = own.results.view(PCG_RESULT).reshape(-1, bodies), own.bodies_device
            counter, pool_counter = self.pcg.counter, own.pool_counter
        else:
            self.rows, self.results = np.zeros(bodies, PCG_BODY), np.zeros((1, bodies), PCG_RESULT)
            self.rows["first"], self.rows["nodes"] = zip(*((b.first, b.last - b.first) for b in w.bodies), strict=True)
            rows, counter, pool_counter = self.rows.ctypes.data, zeros(1, np.int64), zeros(1, np.uint32)
        self.told = np.zeros((len(self.results), bodies), NEWTON_RESULT)
        self._solver: Any = SimpleNamespace(
            counter=counter, pool_counter=pool_counter, results=as_device(self.results), bodies_device=rows,
            launch=self._solve, errors=solves is not None, budgets=bool(sim.scene.solver.step_budget),
            begun=zeros(1, np.int64), clocks=as_device(np.zeros(bodies, PCG.dtype("TrialClock"))),
        )  # fmt: skip
        arrays = {"row_start": s.row_start, "columns": s.columns, "values": s.values, "b": s.b_material, "y": s.y}
        arrays |= {"x": w.x, "v": w.v}
        ranges = [(b.first, b.last) for b in w.bodies]
        device: Any = SimpleNamespace(has_conditions=loops, loop=self._loop, linked=lambda *_: module)
        again: Any = [Launch(self, x) for x in self._assemble]
        self._iteration = NewtonIteration(
            self._gpu, device, newton, again, ranges, arrays, self.phases, self._solver, self.told
        )  # fmt: skip
        self._graphs.begin()
        self._iteration.launch()
        self._graph = self._graphs.end()
        for launch in sim.integrator.begin(self._assemble):
            launch()

    def put(self, name: str, work: Any, guarded: bool, solves: bool = False) -> None:
        """Appends a launch. guarded: it returns at once where no body needs it; solves: needs to be solved."""

        def run() -> None:
            if (guarded and not self.phases.active[0]) or (solves and (self.phases.phase != SOLVE).all()):
                return
            self.ran.append(name)
            work()

        self._graphs.put(run)

    def _loop(self) -> Loop:
        """The number by which kernels tell it is the address of its condition."""
        condition = np.zeros(1, np.int32)
        self._graphs.put(lambda: condition.fill(0))
        return Loop(condition.ctypes.data, lambda: self._graphs.branch(condition, repeats=True))

    def _kernel(self, name: str) -> Any:
        function = getattr(self._library, f"{name}_all")

        def launch(grid: tuple[int], block: tuple[int], arguments: tuple[Any, ...]) -> None:
            given, loop = arguments[0].copy(), c.c_uint64(int(arguments[1]) if len(arguments) > 1 else 0)
            work = lambda: function(c.c_void_p(given.ctypes.data), grid[0], block[0], loop)  # noqa: E731
            self.put(name, work, guarded=name in ("update_state", "accept_trial"))

        return launch

    def _solve(self, values: NDArray[Any] | None = None) -> None:
        s = self.sim.system
        self.put("pcg", lambda: self._solve_bodies(s.values if values is None else np.asarray(values)), guarded=True)

    def _solve_bodies(self, values: NDArray[Any]) -> None:
        s, w = self.sim.system, self.sim.world
        if self._solves:
            given = self.pcg.solver.params.copy()
            given["values"] = values.ctypes.data
            arguments = (given, *self.phases, self.pcg.correction.params)
            self._solves.solve(*(c.c_void_p(x.ctypes.data) for x in arguments))
            return
        for k in np.flatnonzero(self.phases.phase == SOLVE):
            body, result = w.bodies[k], self.results[0, k : k + 1]
            row_start, columns = s.body_pattern(body.first, body.last)
            blocks, n = values[s.row_start[body.first] : s.row_start[body.last]], 3 * (body.last - body.first)
            result[:] = np.zeros(1, PCG_RESULT)
            b = s.b_material[body.nodes]
            if not np.isfinite(b).all():
                result["status"], s.y[body.nodes] = SolveStatus.NOT_FINITE, np.nan
                continue
            assert np.isfinite(blocks).all(), "blocks of A that have not been made"
            matrix = bsr_array((blocks, columns, row_start), shape=(n, n))
            s.y[body.nodes] = spsolve(matrix.tocsc(), b.ravel()).reshape(-1, 3)

    def step(self, number: int) -> NDArray[Any]:
        """Makes a step; returns the result of each body."""
        self.sim.system.clock[0] = number * self.sim.world.dt
        if self._solves:
            self.pcg.renew()
            self.pcg.counter[0] = number
        for launch in (*self._held, *self._assemble):
            launch()
        self.ran.clear()
        self._graph()
        for launch in self._integrate:
            launch()
        return self.told[number % len(self.told)].copy()
