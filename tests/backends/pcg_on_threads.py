# SPDX-License-Identifier: MIT
"""The solver of a GPU (pcg.cu), run by threads of the processor beside steps of the CPU, with a dense inverse in
float16 in place of the partitioned one."""

import ctypes as c
import re
import subprocess
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu.structs import BALANCE
from sim_server.backends.gpu import contact as gpu_contact
from sim_server.backends.gpu import solver as gpu_solver
from sim_server.backends.gpu import solver_layout
from sim_server.backends.gpu.contact import ContactPasses
from sim_server.backends.gpu.correction import CORRECTED_BODY, FactorCorrection
from sim_server.backends.gpu.host_results import ContactResults
from sim_server.backends.gpu.row_partition import assign_blocks
from sim_server.backends.gpu.solver import PCG_RESULT, PcgSolver
from sim_server.backends.gpu.solver_features import SolverFeatures
from sim_server.backends.gpu.structs import CONTACT_RESULT, PCG
from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TESTS, Host, as_device

THREADS = 64  # of a thread block here
SOLVE = """
#include "pcg.cu"
extern "C" void solve(const PcgArguments* s, const Correction* k) {
    *s->pool_counter = 0;
    launch_together(s->grid, THREADS, [&] { pcg(*s, *k); },
                    {{&memory, sizeof memory}, {shared_memory, sizeof shared_memory},
                     {shared_vector, sizeof shared_vector}});
}
"""
STEP = """
#include "contact.cu"
#include "pcg.cu"
extern "C" int step(const ContactArguments* c, const ContactSolve* first, const ContactSolve* later,
                    const PcgArguments* s, const Correction* k, int chunks) {
    auto one_pass = [&](const ContactSolve& pass) {
        launch(chunks, CONTACT_THREADS, [&] { contact_forces(*c); });
        launch(s->grid, THREADS, [&] { pcg(*s, pass, *k); });
        launch(chunks, CONTACT_THREADS, [&] { contact_search(*c); });
    };
    int loops = 0;
    launch(c->count, CONTACT_THREADS, [&] { begin_contact(*c); });
    for (one_pass(*first); *c->active > 0 && loops < 200; ++loops) one_pass(*later);
    launch(chunks, CONTACT_THREADS, [&] { finish_contact(*c); });
    return loops;
}
"""
PLAN = PCG.dtype("DevicePlan")
LAST = 32  # unused entries behind vectors of an inverse
INVERSE = """
#pragma once
#include "block_group.cuh"
static float unit_for(double) { return 1; }
static int first_bad_node(const PcgBody&, const real*, int&) { return -1; }
struct ResidualSource { const FlagWord<float>* r; unsigned r_number, q_number; float alpha; };
static float shared_vector[2048];
constexpr int PADDING = 32;
#ifndef LENT
#define LENT 0
#endif
struct PartitionedInverse {
    Arena lent;  // LENT bytes that nobody else needs between two applications

    const float *scale, *matrix;
    FlagWord<float> *residual, *product, *z;
    uint4* kept;
    int size, phases, near, first, last;  // own rows
    const DevicePlan* plan;
    void reserve(const DevicePlan* shared_plan, int, Arena& arena) {
        plan = shared_plan;
        lent = {arena.next, arena.next + LENT};
        arena.next += LENT;
    }
    void set_up(const PcgBody& body, int index, Arena& arena) {
        size = plan->size; first = index * size / body.blocks; last = (index + 1) * size / body.blocks;
        phases = 1; scale = body.scale; matrix = (const float*)body.matrix;
        residual = body.residual; product = body.product; z = body.z;
        near = plan->entries;
        kept = arena.take<uint4>(32 * near);
    }
    struct Stream {};
    void open(Stream&) const {}
    double multiply(int phase, const ResidualSource& from, unsigned number, float unit, Stream&) const {
        return multiply(phase, from, number, unit);
    }
    void fetch() const {
        for (int k = threadIdx.x; k < 128 * near; k += THREADS) ((int*)kept)[k] = 7;
    }
    void gather(int, const ResidualSource& from, unsigned, float) const {
        for (char* at = lent.next + threadIdx.x; at < lent.end; at += THREADS) *at = 0x7f;
        for (int k = threadIdx.x; k < 128 * near; k += THREADS)
            if (((int*)kept)[k] != 7) std::abort();  // not fetched again
        for (int k = threadIdx.x; k < size; k += THREADS) {
            float r, q = 0;
            for (unsigned spins = 0; keep_polling(!from.r[k].get(r, from.r_number), spins);) {}
            for (unsigned spins = 0; keep_polling(from.alpha != 0 && !product[k].get(q, from.q_number), spins);) {}
            shared_vector[k] = r - from.alpha * q;
        }
    }
    double multiply(int, const ResidualSource&, unsigned number, float) const {
        double zr = 0;
        for (int k = first + threadIdx.x; k < last; k += THREADS) {
            float sum = 0;
            for (int j = 0; j < size; ++j) sum += matrix[(long long)k * size + j] * shared_vector[j];
            z[k].put(scale[k] * sum, number);
            zr += (double)sum * shared_vector[k];
        }
        return zr;
    }
};
"""
MORE = """
struct float4 { float x, y, z, w; };
template <class T> static T __shfl_down_sync(unsigned, T a, int by) { return exchange(a, threadIdx.x % 32 + by); }
template <class T> static T __ldg(const T* a) { return *a; }
static float4 __ldcg(const float4* a) { return *a; }
static unsigned __float_as_uint(float a) { unsigned b; std::memcpy(&b, &a, 4); return b; }
static float __uint_as_float(unsigned a) { float b; std::memcpy(&b, &a, 4); return b; }
static unsigned atomicAdd(unsigned* a, int by) { return __atomic_fetch_add(a, by, __ATOMIC_SEQ_CST); }
static void __trap() { std::abort(); }
static int max(int a, int b) { return a < b ? b : a; }
static unsigned max(unsigned a, unsigned b) { return a < b ? b : a; }
"""
CLOCK = """
#pragma once
static long long nanoseconds() { static long long now; return now += 1000; }
"""
WORDS = [
    (r'asm volatile\("st\.relaxed\.[^\n]*?\.global\.u64[^\n]*\n', "bits = w;\n"),
    (r'asm volatile\("ld\.relaxed\.[^\n]*?\.global\.u64[^\n]*\n', "w = *this;\n"),
    (r'asm volatile\("st\.relaxed\.[^\n]*?\.global\.v2.*?"memory"\);',
     "high = tag | bits >> 32; low = tag | (bits & 0xffffffffull);"),
    (r'asm volatile\("ld\.relaxed\.[^\n]*?\.global\.v2[^\n]*\n', "w = *this;\n"),
    (r"    unsigned to = \(unsigned\)__cvta_generic_to_shared\(shared\);.*?\n\}",
     "    std::memcpy(shared, global, bytes);\n}"),
    (r'asm volatile\("cp\.async\.(commit|wait)_group[^\n]*"memory"\);', ""),
    (r"extern __shared__ __align__\(16\) char shared_memory\[\];", "alignas(16) static char shared_memory[1 << 17];"),
    (r"if \(missing && \+\+spins > 1u << 27\) __trap\(\);",
     "if (missing && ++spins > 100000u) __trap();\n    if (missing) give_turn();"),
]  # fmt: skip


def compiled(folder: Path, text: str, *defined: str) -> c.CDLL:
    """Compiles a text that includes pcg.cu, without instructions of a GPU."""
    gpu = SOURCES / "backends/gpu"
    group, solver = (gpu / "block_group.cuh").read_text(), (gpu / "pcg.cu").read_text()
    for pattern, plain in WORDS:
        group, found = re.subn(pattern, lambda _, p=plain: p, group, flags=re.DOTALL)
        assert found, pattern
    assert "asm" not in group
    approximate = r"    double y;\n    asm\(.*?\n    return y \* \(2 - a \* y\);"
    solver, found = re.subn(approximate, "    return 1 / a;", solver, flags=re.DOTALL)
    assert found == 1
    headers = {"block_group.cuh": group, "pcg.cu": solver, "partitioned_inverse.cuh": INVERSE, "clock.cuh": CLOCK}
    for name, written in headers.items():
        (folder / name).write_text(written)
    for name in ("spmv.cuh", "correction.cuh", "pool_order.cuh", "contact.cu", "smoothed.cu"):  # beside other headers
        (folder / name).write_text((gpu / name).read_text())
    header, found = re.subn(r"CONTACT_THREADS = \d+", f"CONTACT_THREADS = {THREADS}",
                            (gpu / "device_contact.cuh").read_text())  # fmt: skip
    assert found == 1
    (folder / "device_contact.cuh").write_text(header)
    (folder / "solver.cpp").write_text(f'#include "cuda_threads.h"\n{MORE}{text}')
    paths = [f"-I{p}" for p in (folder, TESTS / "backends", gpu, INCLUDE)]
    words = [f"-D{d}" for d in ("real=double", f"THREADS={THREADS}", "PER_PROCESSOR=1", "CORRECTED", *defined)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-w", *words, *paths]
    subprocess.run([*command, str(folder / "solver.cpp"), "-o", str(folder / "solver.so")], check=True)
    return c.CDLL(str(folder / "solver.so"))


class SolverHost(Host):
    """Stands for a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.cp.ones = lambda shape, dtype=float: as_device(np.ones(shape, dtype))
        device = SimpleNamespace(use=lambda: None)
        self.cp.cuda = SimpleNamespace(Device=lambda: device, Stream=lambda **_: None)
        self.properties = {"multiProcessorCount": 132, "sharedMemPerMultiprocessor": 1 << 17}


class Solver:
    """Solves the system of a body of a simulation on a CPU by pcg.cu, too.

    near: pieces of 512 bytes of an inverse that are in shared memory
    blocks: thread blocks of the body
    host: stands for the GPU
    alone: compiled with -DALONE
    phases: NewtonPhases.of_solves, where a step has several linearizations
    """

    def __init__(
        self, sim: Simulation, monkeypatch: pytest.MonkeyPatch, near: int = 0, blocks: int = 1,
        host: SolverHost | None = None, phases: Sequence[Any] = (), alone: bool = False,
    ):  # fmt: skip
        monkeypatch.setattr(solver_layout, "alone", lambda *a: alone)
        monkeypatch.setattr(solver_layout, "threads_and_blocks", lambda *a: (THREADS, 1))
        monkeypatch.setattr(solver_layout, "threads_alone", lambda *a: THREADS)
        monkeypatch.setattr(gpu_solver, "compiled", lambda name, module, kernel: SimpleNamespace())
        assigned = lambda nodes, processors, most: (assign_blocks(nodes, blocks), blocks)  # noqa: E731
        monkeypatch.setattr(solver_layout, "best_assignment", assigned)
        self.sim, self.near = sim, near
        self.gpu: Any = host or SolverHost()
        given = sim.engine_input()
        self.arrays, gpu = given.arrays, self.gpu
        touch: Any = None
        if sim.touch:
            own = {"spring": gpu.twin(sim.touch.spring), "coefficients": as_device(sim.world.coefficients)}
            touch = SimpleNamespace(arrays=own)
        own = sim.scene.solver
        budgets = bool(own.budget or own.step_budget)
        sites = int(given.contact.body_start[-1]) // 2 if given.contact else 0
        self.correction = FactorCorrection(gpu, sim.scene.solver.woodbury, list(given.ranges), touch, sites)
        self.counter, contact = as_device(np.zeros(1, np.int64)), given.contact is not None
        features = SolverFeatures(
            contact=contact, correction=self.correction, errors=given.errors or budgets, phases=phases,
            budgets=budgets, cut=given.cut,
        )  # fmt: skip
        self.solver = PcgSolver(gpu, given.ranges, given.arrays, self.counter, 4, features)
        rows = self.solver.bodies
        assert rows["blocks"].sum() == blocks
        rows["tolerance"], rows["max_iterations"], rows["warm_start"] = (
            own.tolerance,
            own.max_iterations,
            own.warm_start,
        )
        for body, row in zip(sim.world.bodies, rows, strict=True):
            settings = sim.engine.settings(body.index)
            for name in ("position", "trust", "dx_dv", "budget", "step_budget"):
                row[name] = getattr(settings, name)
        rows["kind"] = KINDS.enumeration("Kind")["BLOCK_JACOBI" if own.preconditioner == "block_jacobi" else "CHOLESKY"]
        rows["factor_step"] = -1
        self.kept: list[Any] = []

    @property
    def used(self) -> int:
        """Nodes of the first body that have columns."""
        return int(self.correction.bodies.view(CORRECTED_BODY)["used"][0])

    def post(self, values: np.ndarray, step: int) -> None:
        """Gives both a factor of the matrix of a step."""
        row_start, columns = self.sim.system.body_pattern(0, self.sim.world.nodes)
        analysis = Analysis(row_start, columns)
        self.sim.engine.post_factor(0, analysis.pattern, analysis.factorize(values, np.float32), step)
        n = 3 * self.sim.world.nodes
        dense = np.zeros((n // 3, 3, n // 3, 3))
        dense[np.repeat(np.arange(n // 3), np.diff(row_start)), :, columns, :] = values
        inverse = np.linalg.inv(dense.reshape(n, n))
        place = np.arange(n // 3)[::-1].astype(np.int32) * 3  # positions are not those of the nodes
        position = (place[:, None] + np.arange(3)).reshape(-1)
        packed = np.empty_like(inverse)
        packed[np.ix_(position, position)] = inverse
        scale = np.sqrt(np.diag(packed))
        stored = (packed / scale / scale[:, None]).astype(np.float16).astype(np.float32)
        plan = np.zeros(1, PLAN)
        plan["size"], plan["place"], plan["entries"], plan["phases"] = n, place.ctypes.data, self.near, 1
        row = self.solver.bodies
        parts = {"matrix": stored, "scale": np.append(scale, scale.max()).astype(np.float32), "plan": plan}
        parts |= {name: np.zeros((2, n + LAST), np.uint64) for name in ("residual", "product", "z")}
        self.kept.append((parts, place))
        for name, array in parts.items():
            row[name] = array.ctypes.data
        row["planes"], row["factor_step"] = 1, step

    def renew(self) -> None:
        """Takes what the CPU has before a solve."""
        self.gpu.renew()
        c.memmove(self.solver.bodies_device, self.solver.bodies.ctypes.data, self.solver.bodies.nbytes)

    def launched(self, library: c.CDLL) -> None:
        library.solve(*(c.c_void_p(x.ctypes.data) for x in (self.solver.params, self.correction.params)))

    def solve(self, library: c.CDLL) -> tuple[np.void, np.void]:
        """Makes a step; returns the results of both."""
        self.sim.engine.assemble()
        self.matrix = self.sim.engine.factor_matrix(0).copy()
        self.renew()
        self.launched(library)
        self.sim.engine.solve()
        ours, theirs = self.gpu.twin(self.arrays["y"]), self.arrays["y"]
        self.error = float(np.abs(ours - theirs).max() / np.abs(theirs).max())
        result = self.solver.results.view(PCG_RESULT)[int(self.counter[0]) % 4].copy()
        self.counter += 1
        return result, self.sim.engine.records()[-1]


class ContactSolver(Solver):
    """The same with contact."""

    def __init__(self, sim: Simulation, monkeypatch: pytest.MonkeyPatch, near: int = 0):
        super().__init__(sim, monkeypatch, near)
        monkeypatch.setattr(gpu_contact, "THREADS", THREADS)
        monkeypatch.setattr(gpu_contact, "options", lambda types: ())
        monkeypatch.setattr(gpu_contact, "compiled", lambda name, module, kernel: None)
        given = sim.engine_input()
        device: Any = SimpleNamespace(repeat=lambda flag: nullcontext())
        assert given.contact is not None
        obstacles = len(given.contact.obstacles.kind)
        self.told, self.reactions = np.zeros((4, 1), CONTACT_RESULT), np.zeros((4, 1, obstacles, 6))
        self.passes = ContactPasses(
            self.gpu, device, given.contact, given.ranges, given.arrays, self.solver, as_device(np.zeros(1, BALANCE)),
            ContactResults(self.told, self.reactions, np.zeros(0, np.int32), None), self.correction,
        )  # fmt: skip
        self.solver.params["b"] = self.passes.memory["contact_b"].data.ptr

    def launched(self, library: c.CDLL) -> None:
        passes = self.passes
        given = (passes.params, passes.first, passes.later, self.solver.params, self.correction.params)
        assert library.step(*(c.c_void_p(x.ctypes.data) for x in given), passes.grid) < 200


def steps(solver: Solver, library: c.CDLL, count: int, factor_at: int = -1) -> list[tuple[int, int]]:
    """Iterations of steps on a GPU and a CPU. factor_at: step after which both have a factor of its matrix."""
    found = []
    for _ in range(count):
        step = int(solver.counter[0])
        ours, theirs = solver.solve(library)
        assert ours["status"] == 0 and ours["fallbacks"] == 0 and solver.error < 1e-4
        found.append((int(ours["iterations"]), int(theirs["iterations"])))
        if step == factor_at:
            solver.post(solver.matrix, step)
    return found
