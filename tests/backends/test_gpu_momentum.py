# SPDX-License-Identifier: MIT
"""Momenta of free bodies as the kernels of a GPU set them, run by threads of the processor, beside those of a CPU."""

import ctypes as c
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.gpu.momentum import FREE_BODIES, MOMENTUM, SUMS, chunks_of_blocks
from sim_server.backends.gpu.rosenbrock import EULER, FACTOR, ITERATE, STAGE_DECISION
from sim_server.backends.gpu.solver import PCG_BODY
from sim_server.backends.gpu.structs import STAGE_RESULT, STAGE_STATE
from sim_server.backends.kinds import Kind

BLOCK = 32  # items of a thread block
H, GAMMA = 0.01, 1 - np.sqrt(0.5)
FAR = np.array([300.0, -200.0, 100.0])  # [m] of the bodies from the world's origin
PREPARED = ("predictor", "damping_velocity", "inertial_increment", "dv")
GPU = """
#define BLOCK_ITEMS 32
#include "cuda_threads.h"
#define index node_index  // the system has a function of this name
#include "momentum.cu"
extern "C" void keep(int blocks, const FreeBodies* t) { launch(blocks, BLOCK_ITEMS, [&] { keep_forces(*t); }); }
extern "C" void end_attempt(int blocks, const FreeBodies* t) {
    launch(blocks, BLOCK_ITEMS, [&] { sum_and_decide(*t); });
}
extern "C" void end_step(int chunks, const FreeBodies* t) { launch(chunks, BLOCK_ITEMS, [&] { set_momenta(*t); }); }
"""
CPU = """
#include "momentum.h"
extern "C" int momenta(int n, const double* mass, const double* share, const double* weight, const double* diagonal,
                       double* states[4], double* b[2], double* inertia[2], double* ends[2]) {
    Stages stages = {};
    stages.mass = mass, stages.share = share, stages.weight = weight, stages.diagonal = diagonal;
    stages.start_x = states[0], stages.start_v = states[1];
    Loop loop = {};
    loop.stages = &stages;
    Body body = {};
    body.last = n;
    MomentumSums sums = {};
    for (int stage = 0; stage < 2; ++stage) {
        loop.x = states[2 * stage], stages.b = b[stage], stages.inertial_increment = inertia[stage];
        if (!add_impulses(loop, body, states[0], sums)) return 0;
    }
    loop.x = ends[0], loop.v = ends[1];
    set_momenta(loop, body, sums);
    return 1;
}
"""


def built(folder: Path, name: str, text: str, *includes: Path) -> c.CDLL:
    (folder / f"{name}.cpp").write_text(text)
    (folder / "clock.cuh").write_text("#pragma once\nstatic long long nanoseconds() { return 77; }\n")
    paths = [f"-I{p}" for p in (folder, *includes, INCLUDE)]
    command = [compiler(), "-std=c++17", "-O1", "-shared", "-fPIC", "-pthread", "-Dreal=double", "-w", *paths]
    subprocess.run([*command, str(folder / f"{name}.cpp"), "-o", str(folder / f"{name}.so")], check=True)
    return c.CDLL(str(folder / f"{name}.so"))


@pytest.fixture(scope="module")
def gpu(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("gpu")
    return built(folder, "gpu", GPU, Path(__file__).parent, SOURCES / "backends/gpu")


@pytest.fixture(scope="module")
def cpu(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return built(tmp_path_factory.mktemp("cpu"), "cpu", CPU, SOURCES / "backends/cpu/native")


def pointers(*arrays: NDArray) -> Any:
    return (c.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays))


class Bodies:
    """Random ones of so many nodes each, in a step with random forces. held: bodies with fixed nodes.

    states: x and v at the start, x_2 and v_2. ends: x and v as the stages leave them. b: of both stages, world frame.
    """

    def __init__(self, sizes: list[int], held: tuple[int, ...] = ()):
        rng, n, count = np.random.default_rng(len(sizes)), sum(sizes), len(sizes)
        self.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        self.body = np.repeat(np.arange(count, dtype=np.int32), sizes)
        self.unheld = np.array([k not in held for k in range(count)], np.int32)
        normal = lambda: rng.normal(size=(n, 3))  # noqa: E731
        self.mass, self.share = rng.uniform(1, 2, n), rng.uniform(0.5, 1, n)
        self.weight, self.spring, self.first_spring = self.share * 1.1, np.zeros(n), np.full(n, np.nan)
        self.start_x, self.start_v, self.first = FAR + normal(), normal(), normal()
        self.x, self.v = self.start_x + 0.1 * normal(), normal()
        s = (1 / GAMMA - 2) * self.first - self.start_v
        w = self.weight[:, None]
        self.inertia = [w * self.start_v, w * s - 2 * self.first]
        self.forces = [normal(), normal()]  # g h times
        self.world_b = [f + self.mass[:, None] * r for f, r in zip(self.forces, self.inertia, strict=True)]
        self.rotation = np.ascontiguousarray(Rotation.random(n, random_state=1).as_matrix())
        self.first_b = np.full((n, 3), np.nan)
        self.prepared = {name: np.full((n, 3), np.nan) for name in PREPARED}
        self.chunks, self.first_chunk = chunks_of_blocks(self.starts, self.unheld, BLOCK)
        self.sums = np.full(len(self.chunks) * SUMS.itemsize // 8, np.nan)
        self._decide(count, n)

    def _decide(self, count: int, n: int) -> None:
        self.state, self.rows = np.zeros(count, STAGE_STATE), np.zeros(count, PCG_BODY)
        self.state["form"], self.rows["kind"] = ITERATE, Kind.BLOCK_JACOBI
        self.phase, self.largest, self.bound = np.zeros(count, np.int32), np.zeros(count, "i8"), np.ones(count)
        self.estimate, self.moving, self.left = np.full(n, 0.5), np.ones(count, np.int32), np.zeros(1, np.int32)
        self.results, self.step, self.finished = (
            np.zeros((2, count), STAGE_RESULT),
            np.zeros(1, "i8"),
            np.zeros(1, "u4"),
        )
        self.clock, self.stamps, self.counters = np.zeros(1), np.zeros((2, 2), "i8"), np.zeros(5, "u4")
        self.begun = np.zeros(1, "i8")

    def params(self, b: NDArray, attempt: int = ITERATE) -> Any:
        """Arguments of the kernels. b: in the frames of the nodes."""
        decision, params = np.zeros((), STAGE_DECISION), np.zeros((), FREE_BODIES)
        for name in ("state", "phase", "largest", "bound", "rows", "estimate", "body", "results", "left"):
            decision[name] = getattr(self, name).ctypes.data
        end: Any = decision["end"]
        for name, array in {
            "clock": self.clock, "step": self.step, "pool_counters": self.counters, "finished_blocks": self.finished,
            "timestamps": self.stamps, "moving": self.moving, "begun": self.begun,
        }.items():  # fmt: skip
            end[name] = array.ctypes.data
        end["counters"], end["capacity"], end["bodies"] = 5, 2, len(self.phase)
        decision["attempt"], decision["nodes"] = attempt, len(self.body)
        params["decision"], params["h"], params["b"] = decision, H, b.ctypes.data
        for name in ("chunks", "first_chunk", "sums", "rotation", "mass", "share", "weight", "spring", "first_spring",
                     "first_b", "start_x", "start_v", "first", "x", "v"):  # fmt: skip
            params[name] = getattr(self, name).ctypes.data
        for name, array in self.prepared.items():
            params[name] = array.ctypes.data
        return params

    def call(self, function: Any, blocks: int, stage: int, attempt: int) -> None:
        b = np.einsum("nji,nj->ni", self.rotation, self.world_b[stage])
        params = self.params(b, attempt)
        function(blocks, c.c_void_p(params.ctypes.data))

    def attempt(self, gpu: c.CDLL, form: int) -> None:
        blocks = -(-len(self.body) // BLOCK)
        self.call(gpu.keep, blocks, 0, form)
        self.call(gpu.end_attempt, blocks, 1, form)

    def end(self, gpu: c.CDLL) -> None:
        assert self.step[0] == 1 and self.left[0] == 0 and not self.moving.any()
        self.call(gpu.end_step, len(self.chunks), 1, EULER)

    def on_cpu(self, cpu: c.CDLL, body: int) -> NDArray | None:
        """v at the end of the step, None if a spring holds the body."""
        nodes = slice(self.starts[body], self.starts[body + 1])
        part = lambda a: a[nodes].copy()  # noqa: E731
        second_x = self.start_x + H * (self.start_v + self.first)
        states = [part(a) for a in (self.start_x, self.start_v, second_x, self.v)]
        diagonal = self.mass * self.weight / self.share + self.spring
        numbers = [part(a) for a in (self.mass, self.share, self.weight, diagonal)]
        b, inertia, ends = map(part, self.world_b), map(part, self.inertia), [part(self.x), part(self.v)]
        b, inertia = list(b), list(inertia)
        free = cpu.momenta(
            len(states[0]), *(c.c_void_p(a.ctypes.data) for a in numbers), pointers(*states), pointers(*b),
            pointers(*inertia), pointers(*ends),
        )  # fmt: skip
        return ends[1] if free else None

    def momenta(self, body: int, x: NDArray, v: NDArray) -> NDArray:
        """Momentum, and angular momentum about the world's origin."""
        nodes = slice(self.starts[body], self.starts[body + 1])
        m, x, v = self.mass[nodes, None], x[nodes], v[nodes]
        return np.concatenate([(m * v).sum(axis=0), np.cross(x, m * v).sum(axis=0)])

    def expected(self, body: int) -> NDArray:
        """The momenta at the end of the step, as the forces make them."""
        nodes = slice(self.starts[body], self.starts[body + 1])
        at = [self.start_x, self.start_x + H * (self.start_v + self.first)]
        impulses = [0.5 / GAMMA * f for f in self.forces]
        both = zip(at, impulses, strict=True)
        made = [np.concatenate([f[nodes].sum(axis=0), np.cross(x[nodes], f[nodes]).sum(axis=0)]) for x, f in both]
        return self.momenta(body, self.start_x, self.start_v) + sum(made)

    def check(self, before: "Bodies", cpu: c.CDLL, free: list[bool]) -> None:
        """That free bodies have what a CPU gives them, and the next step is prepared; others are as `before`."""
        for body, is_free in enumerate(free):
            nodes = slice(self.starts[body], self.starts[body + 1])
            if not is_free:
                assert np.array_equal(self.v[nodes], before.v[nodes])
                assert all(np.isnan(array[nodes]).all() for array in self.prepared.values())
                continue
            wanted = before.on_cpu(cpu, body)
            assert wanted is not None and np.abs(wanted - before.v[nodes]).max() > 0.1
            np.testing.assert_allclose(self.v[nodes], wanted, rtol=0, atol=1e-12)
            if nodes.stop - nodes.start > 2:  # else without extent across an axis
                got, size = self.momenta(body, self.x, self.v), np.linalg.norm(FAR) * self.mass[nodes].sum()
                np.testing.assert_allclose(got, before.expected(body), rtol=0, atol=1e-13 * size)
            share, weight, v = self.share[nodes, None], self.weight[nodes, None], self.v[nodes]
            prepared = [(1 - share) * v, (1 - share) * v, weight * v, share * v]
            for array, right in zip(self.prepared.values(), prepared, strict=True):
                np.testing.assert_allclose(array[nodes], right, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("sizes", [[1], [5], [32], [33], [100], [3, 40, 1, 64, 7, 9, 200]])
def test_free_bodies_get_the_momenta_that_their_forces_make(gpu, cpu, sizes):
    bodies, before, again = Bodies(sizes), Bodies(sizes), Bodies(sizes)
    for each in (bodies, again):
        each.attempt(gpu, ITERATE)
        each.end(gpu)
    bodies.check(before, cpu, [True] * len(sizes))
    assert bodies.v.tobytes() == again.v.tobytes() and np.array_equal(bodies.x, before.x)


def test_bodies_that_something_holds_are_left_alone(gpu, cpu):
    """One has fixed nodes, a grab pulls at two, in one of the stages each, and one rests."""
    sizes = [40, 40, 30, 50, 20, 10]
    bodies, before = Bodies(sizes, held=(1,)), Bodies(sizes, held=(1,))
    assert 1 not in bodies.chunks["body"]
    bodies.moving[4] = 0
    bodies.spring[85] = 3.0
    bodies.call(gpu.keep, -(-190 // BLOCK), 0, ITERATE)
    bodies.spring[85], bodies.spring[155] = 0.0, 2.0
    bodies.call(gpu.end_attempt, -(-190 // BLOCK), 1, ITERATE)
    bodies.end(gpu)
    bodies.check(before, cpu, [True, False, False, False, False, True])
    before.spring[155] = 2.0
    assert before.on_cpu(cpu, 3) is None


def test_the_sums_are_those_of_the_attempt_that_is_the_step(gpu, cpu):
    """Bodies whose step the first, the second and the third attempt makes; backward Euler has no such forces."""
    sizes = [50, 30, 40]
    bodies, before = Bodies(sizes), Bodies(sizes)
    bodies.estimate[50:] = 2.0
    wrong = bodies.first.copy()
    bodies.first[50:80] = 9.0
    bodies.attempt(gpu, ITERATE)
    assert bodies.left[0] == 2 and bodies.phase.tolist() == [2, 0, 0]
    bodies.first[:], bodies.estimate[50:80] = wrong, 0.5
    bodies.first[:50] = np.nan  # of a body whose step is made
    bodies.attempt(gpu, ITERATE)
    assert bodies.left[0] == 1
    bodies.attempt(gpu, EULER)
    bodies.end(gpu)
    bodies.check(before, cpu, [True, True, False])


def test_chunks_end_with_thread_blocks():
    chunks, first = chunks_of_blocks(np.array([0, 10, 100, 132], np.int32), np.array([1, 0, 1], np.int32), 32)
    assert chunks.tolist() == [(0, 0, 10, 0, 1), (2, 100, 128, 1, 2), (2, 128, 132, 1, 2)]
    assert first.tolist() == [0, 1, 1, 1, 2, 3]
    assert SUMS.itemsize // 8 <= BLOCK and MOMENTUM.enumeration("StepPhase")["OPEN"] == 0 and FACTOR != EULER
