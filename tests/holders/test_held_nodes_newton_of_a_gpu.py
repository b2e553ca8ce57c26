# SPDX-License-Identifier: MIT
"""Holders with Newton-Raphson on a GPU: its kernels, run by threads of the processor, beside the loop of the CPU."""

import ctypes as c
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.gpu import device, kernel_fusion
from sim_server.backends.gpu import engine as gpu_engine
from sim_server.backends.gpu.inverse.workspace import workspace
from sim_server.backends.gpu.newton import NEWTON_ARGUMENTS, SEARCH, node_ranges
from sim_server.backends.gpu.solver import PCG_BODY
from sim_server.backends.gpu.structs import NEWTON_RESULT, PCG_RESULT
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.holders.holder_scenes import held_bar, left, right
from tests.support import nvrtc

TESTS = Path(__file__).parent.parent
MOTION = [{"time": 0.0}, {"time": 0.2, "translate": [0.1, 0.2, 0], "rotate": [0, 40, 90]}]
SOLVE, TRY, DONE = range(3)
TEXT = """
#include "cuda_threads.h"
#include "newton.cu"
#define STEP(name, threads) \\
    extern "C" void name##_all(const NewtonArguments* p, int grid) { launch(grid, threads, [&] { name(*p); }); }
STEP(begin_newton, BLOCK_NODES)
STEP(update_state, ALL_LANES)
STEP(accept_trial, BLOCK_NODES)
STEP(end_newton, BLOCK_NODES)
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("newton")
    (folder / "newton.cpp").write_text(TEXT)
    paths = [f"-I{p}" for p in (TESTS / "backends", SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-Dreal=double", "-w", *paths]
    subprocess.run([*command, str(folder / "newton.cpp"), "-o", str(folder / "newton.so")], check=True)
    return c.CDLL(str(folder / "newton.so"))


class OnThreads:
    """The step of a scene in the order of a GPU: holders move once, before the first assembly."""

    def __init__(self, library: c.CDLL, sim: Simulation):
        self.sim, self.library, s, w = sim, library, sim.system, sim.world
        assemble, integrate = sim.launches()
        self.first = [x for x in assemble if x.domain not in kernel_fusion.DOMAINS]
        self.again = assemble[len(self.first) :]
        self.integrate = integrate
        nodes, newton = w.nodes, sim.integrator.newton(assemble, slice(0, 0), list(sim.effects.values()))
        ranges, first_range = node_ranges(np.array([(b.first, b.last) for b in w.bodies], np.int64))
        self.grid, bodies = len(ranges), len(w.bodies)
        rows = np.zeros(bodies, PCG_BODY)
        self.memory: dict[str, Any] = {
            "row_start": s.row_start, "columns": s.columns, "values": s.values, "b": s.b_material, "y": s.y,
            "x": w.x, "v": w.v, "ranges": ranges, "first_range": first_range, "bodies": rows,
            "partial_sums": np.zeros(2 * len(ranges)), "finished_blocks": np.zeros(bodies, np.uint32),
            "search": np.zeros(bodies, SEARCH), "phase": np.zeros(bodies, np.int32),
            "active": np.full(1, bodies, np.int32), "bad_node": np.zeros(bodies, np.int32),
            "step": np.zeros(1, np.int64), "pool_counter": np.zeros(1, np.uint32),
            "results": np.zeros((8, bodies), PCG_RESULT), "newton_results": np.zeros((8, bodies), NEWTON_RESULT),
            "initial_state": np.zeros(12 * nodes), "increment": np.zeros(3 * nodes), "direction": np.zeros(3 * nodes),
        } | newton.arrays  # fmt: skip
        self.params: Any = np.zeros((), NEWTON_ARGUMENTS)
        for name, array in self.memory.items():
            self.params[name] = array.ctypes.data
        self.params["dx_dv"], self.params["tolerance"] = newton.dx_dv, newton.options.tolerance
        self.params["linearizations"], self.params["trials"] = newton.options.linearizations, newton.options.trials
        self.params["nodes"], self.params["count"], self.params["capacity"] = nodes, bodies, 8
        for launch in sim.integrator.begin(self.again):
            launch()

    def _run(self, kernel: str) -> None:
        getattr(self.library, kernel + "_all")(self.params.ctypes.data_as(c.c_void_p), self.grid)

    def _solve(self) -> None:
        for body in np.flatnonzero(self.memory["phase"] == SOLVE):
            nodes = self.sim.world.bodies[body].nodes
            y = spsolve(self.sim.matrix(body), self.memory["b"][nodes].ravel())
            self.memory["y"][nodes] = y.reshape(-1, 3)

    def step(self, number: int) -> np.ndarray:
        """Returns the result of each body."""
        self.sim.system.clock[0] = number * self.sim.world.dt
        for launch in (*self.first, *self.again):
            launch()
        self._run("begin_newton")
        while self.memory["active"][0]:
            self._solve()
            self._run("update_state")
            for launch in self.again:
                launch()
            self._run("accept_trial")
        self._run("end_newton")
        for launch in self.integrate:
            launch()
        return self.memory["newton_results"][0].copy()


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha", "quasi_static"])
def test_steps_and_forces_are_those_of_the_cpu(library, scheme):
    keys: dict[str, Any] = {
        "integrator": {"scheme": scheme, "linearizations": 12, "tolerance": 1e-10},
        "gravity": (0, -9.81, 0), "damping": (0.2, 0.01), "cells": (4, 1, 2), "solver": {"tolerance": 1e-13},
    }  # fmt: skip
    cpu, beside = (held_bar(left(), right(keyframes=MOTION), **keys) for _ in range(2))
    kernels, largest = OnThreads(library, beside), 0.0
    for number in range(5):
        result = kernels.step(number)
        cpu.engine.run(1)
        record = cpu.engine.records()[0]
        assert result["linearizations"][0] == record["linearizations"] > 1
        np.testing.assert_allclose(beside.world.x, cpu.world.x, atol=1e-9)
        np.testing.assert_allclose(beside.world.v, cpu.world.v, atol=1e-7)
        largest = max(largest, float(np.abs(cpu.world.reaction).max()))
        np.testing.assert_allclose(beside.world.reaction, cpu.world.reaction, atol=1e-6 * largest)
    assert largest > 0


def test_later_assemblies_leave_what_the_forces_are_made_of(tmp_path, monkeypatch):
    """The right-hand side at held nodes of the last one: no array that stays in registers. Without holders it may."""
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: (b"code", ""))
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy.made(tmp_path, None))
    monkeypatch.setattr(gpu_engine, "CudaDevice", fake_cupy.Device)
    caches = (device.cupy, device.processors, workspace)
    for function in caches:
        function.cache_clear()
    asked, fused = [], kernel_fusion.FusedSource

    def source(launches: Any, shape: Any, epilogue: Any, private: frozenset[int], guard: Any, *rest: Any) -> Any:
        if guard:
            asked.append(private)
        return fused(launches, shape, epilogue, private, guard, *rest)

    monkeypatch.setattr(kernel_fusion, "FusedSource", source)
    newton = {"scheme": "newmark", "linearizations": 3}
    for holders, kept in (((left(),), False), ((), True)):
        asked.clear()
        sim = held_bar(*holders, integrator=newton, device="gpu", **({} if holders else {"fixed": "X < 0.01"}))
        b = int(sim.engine.gpu.twin(sim.system.b).data.ptr)
        assert asked and any(b in private for private in asked) == kept
    for function in caches:
        function.cache_clear()
