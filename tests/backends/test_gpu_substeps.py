# SPDX-License-Identifier: MIT
"""What a GPU decides between explicit substeps, made by threads of the processor, beside the loop of the CPU."""

import ctypes as c
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu.structs import BALANCE, STABLE_STEP
from sim_server.backends.gpu.central_difference import FIRST_ITERATIONS, SUBSTEP_STATE, SUBSTEPS, THREADS
from sim_server.backends.gpu.structs import PCG_RESULT, SUBSTEP_RESULT
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation

CAPACITY = 64
TEXT = """
#include "cuda_threads.h"
#include "central_difference.cu"
extern "C" {
void measure(int blocks, int threads, const Substeps* p, int k) {
    launch(blocks, threads, [&] { measure_frequency(*p, k); });
}
void begin(int threads, const Substeps* p) { launch(1, threads, [&] { begin_substeps(*p); }); }
void shorten_all(int threads, const Substeps* p) { launch(1, threads, [&] { shorten_substeps(*p); }); }
void end(int blocks, int threads, const Substeps* p) { launch(blocks, threads, [&] { end_round(*p); }); }
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("substeps")
    (folder / "substeps.cpp").write_text(TEXT)
    paths = [f"-I{p}" for p in (folder, Path(__file__).parent, SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++17", "-O1", "-shared", "-fPIC", "-pthread", "-Dreal=double", *paths]
    subprocess.run([*command, str(folder / "substeps.cpp"), "-o", str(folder / "substeps.so")], check=True)
    return c.CDLL(str(folder / "substeps.so"))


class OnThreads:
    """Steps of a scene by the kernels of a GPU, in the order of its graph (SubstepLoop.launch)."""

    def __init__(self, library: c.CDLL, sim: Simulation, each: int):
        self.library, self.sim, given = library, sim, sim.engine_input()
        assert given.substeps is not None
        self.substeps, self.forces, self.each = given.substeps, given.assemble[given.substeps.held :], each
        e, bodies = given.energies, len(given.ranges)
        self.stable, self.state = np.zeros(bodies, STABLE_STEP), np.zeros(1, SUBSTEP_STATE)
        self.substeps.set_bodies(self.stable)
        self.state["round"] = each
        self.balance = np.frombuffer(e.balance.tobytes(), BALANCE).copy()
        self.balance["limit"], self.balance["start"], self.balance["floor"] = 1e9, 1e9, 1e9
        self.flags = {name: np.zeros(1, np.int32) for name in ("due", "runs", "opens")}
        self.step, self.results = np.zeros(1, "i8"), np.ones((CAPACITY, bodies), PCG_RESULT)
        self.told, self.bodies = np.zeros((CAPACITY, bodies), SUBSTEP_RESULT), bodies
        self.params = np.zeros((), SUBSTEPS)
        s = self.substeps
        own: dict[str, Any] = {
            "state": self.state, "stable": self.stable, "force": s.force, "mode": s.mode, "kept_x": s.kept_x,
            "kept_force": s.kept_force, "substep": s.substep, "shift_time": s.shift_time, "failed": s.failed,
            "away": np.zeros(bodies, np.int32), "finished": np.zeros(1, "u4"), "results": self.results,
            "told": self.told, **self.flags,
        }  # fmt: skip
        energy: dict[str, Any] = {
            "first_node": e.starts, "mass": e.mass, "before": e.before, "x": e.x, "v": e.v, "free": e.free,
            "gravity": e.gravity, "balance": self.balance, "step": self.step, **e.touch,
        }  # fmt: skip
        self.kept = own, energy
        for name, array in own.items():
            self.params[name] = array.ctypes.data
        for name, array in energy.items():
            self.params["energy"][name] = array.ctypes.data
        self.params["energy"]["bodies"], self.params["energy"]["capacity"] = bodies, CAPACITY
        self.params["energy"]["inertia"], self.params["dt"] = 1, given.dt
        self.address = c.c_void_p(self.params.ctypes.data)

    def evaluate(self) -> None:
        for launch in self.forces:
            launch()

    def iterate(self, k: int) -> None:
        self.substeps.displace()
        self.evaluate()
        self.library.measure(self.bodies, THREADS, self.address, k)

    def start(self) -> None:
        self.evaluate()
        self.substeps.keep()
        for k in range(FIRST_ITERATIONS):
            self.iterate(k)

    def one_step(self) -> None:
        self.substeps.remember()
        self.library.begin(THREADS, self.address)
        while self.flags["runs"][0]:
            if self.flags["opens"][0]:
                self.substeps.open()
            if self.flags["due"][0]:
                self.evaluate()
                self.substeps.keep()
                self.iterate(FIRST_ITERATIONS)
                self.library.shorten_all(THREADS, self.address)
                self.substeps.shift()
            for _ in range(self.each):
                self.evaluate()
                self.substeps.kick()
            self.library.end(self.bodies, THREADS, self.address)
        self.substeps.close()
        self.step += 1


def falling(**table: Any) -> Simulation:
    """Two bars, of which one is held; its elements are crushed as it falls."""
    soft = {**bar((4, 2, 2), (4, 1, 1), name="soft"), "effects": {"fixed": {"where": "X < 0.01"}}}
    soft["effects"]["stable_neo_hookean"] = {"young": 3e4, "poisson": 0.45}
    soft["effects"]["rayleigh"] = {"mass": 0.3}
    return simulation(
        soft, bar((2, 1, 1), (1, 0.5, 0.5), name="free", young=1e4), dt=0.05, gravity=(0, 0, -9.8),
        integrator={"scheme": "central_difference"}, **table,
    )  # fmt: skip


def test_a_gpu_makes_the_substeps_of_the_cpu(library: c.CDLL) -> None:
    here, there = falling(), OnThreads(library, falling(), 1)
    steps = 25
    here.engine.run(steps)
    there.start()
    for _ in range(steps):
        there.one_step()
    records, told = here.engine.records(), there.told[:steps].ravel()
    assert (told["substeps"] == records["substeps"]).all() and len(set(told["substeps"])) > 1
    assert np.allclose(told["stable_step"], records["stable_step"], rtol=1e-6)
    assert np.abs(there.sim.world.x - here.world.x).max() < 1e-9
    assert np.abs(there.sim.world.v - here.world.v).max() < 1e-7
    results = there.results[:steps].ravel()
    assert not results["status"].any() and not results["iterations"].any() and (results["factor_step"] == -1).all()
    assert there.kept[0]["finished"][0] == 0


def test_rounds_hold_several_substeps(library: c.CDLL) -> None:
    one, four = OnThreads(library, falling(), 1), OnThreads(library, falling(), 4)
    for run in (one, four):
        run.start()
        for _ in range(10):
            run.one_step()
    assert (four.told[:10]["substeps"] % 4 == 0).all()
    assert (four.told[:10]["substeps"] >= one.told[:10]["substeps"]).all()
    assert np.abs(one.sim.world.x - four.sim.world.x).max() < 0.02


def test_a_step_that_runs_away_is_made_again_with_shorter_substeps(library: c.CDLL) -> None:
    run = OnThreads(library, falling(), 4)
    run.start()
    run.one_step()
    before = int(run.told[0, 0]["substeps"])
    run.balance["start"], run.balance["floor"], run.balance["largest"] = -1e9, 0.0, 0.0  # whatever moves runs away
    run.one_step()
    assert run.told[1, 0]["substeps"] == 16 * before and run.state["tries"][0] == 4
    assert np.isfinite(run.sim.world.x).all() and run.results[1, 0]["status"] == 0


def test_a_body_without_a_state_goes_back(library: c.CDLL) -> None:
    run = OnThreads(library, falling(), 4)
    run.start()
    run.one_step()
    soft, free = (body.nodes for body in run.sim.world.bodies)
    run.sim.world.v[free.start] = np.nan
    start = run.sim.world.x.copy()
    run.one_step()
    assert run.results[1]["status"].tolist() == [0, 5]
    assert (run.sim.world.x[free] == start[free]).all() and not run.sim.world.v[free].any()
    assert np.isfinite(run.sim.world.x[soft]).all() and (run.sim.world.x[soft] != start[soft]).any()
