# SPDX-License-Identifier: MIT
"""The application of an inverse on a GPU (partitioned_inverse.cuh), run by threads of the processor, beside NumPy."""

import ctypes as c
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.gpu.inverse.device_plan import DevicePlan
from sim_server.backends.gpu.inverse.partition import tree_of
from sim_server.backends.gpu.inverse.plan import Plan, lay_out
from sim_server.backends.gpu.structs import PCG
from tests.backends.pcg_on_threads import MORE, WORDS
from tests.contact.kernels_beside import TESTS
from tests.reference.partitioned import stored
from tests.solver.test_partitioned_inverse import system
from tests.worker.block_matrices import bar_edges, pattern

THREADS = {"several": 128, "alone": 128, "alone, of sixteen warps": 512}
"""Of a thread block."""
PARTS = """
#include "partitioned_inverse.cuh"
extern "C" void apply(const PcgBody* body, const DevicePlan* plan, float alpha, float unit, int shared, double* zr) {
    launch_together(body->blocks, THREADS, [&] {
        Arena arena = {shared_memory, shared_memory + shared};
        PartitionedInverse inverse;
        inverse.reserve(plan, blockIdx.x, arena);
        inverse.set_up(*body, blockIdx.x, arena);
        inverse.fetch();
        for (int k = threadIdx.x; k < plan->size + PADDING; k += THREADS) {  // where they are not in shared memory
            inverse.residual[k] = body->residual[k];
#ifndef ALONE  // one thread block has d r after the update alone
            inverse.product[k] = body->product[k];
#endif
        }
        __syncthreads();
        ResidualSource from = {inverse.residual, 1, 2, alpha};
        double mine = 0;
#ifdef ALONE
        PartitionedInverse::Stream stream;
        inverse.open(stream);
#endif
        for (int phase = 0; phase < inverse.phases; ++phase) {
            inverse.gather(phase, from, 3, unit);
            __syncthreads();
#ifdef ALONE
            mine += inverse.multiply(phase, from, 3, unit, stream);
#else
            mine += inverse.multiply(phase, from, 3, unit);
#endif
            __syncthreads();
            if (phase == 0 && alpha != 0) {  // as the solver publishes d r after the update
                FlagWord<float>* next = inverse.residual + inverse.size + PADDING;
                for (int k = blockIdx.x * THREADS + threadIdx.x; k < inverse.size; k += body->blocks * THREADS) {
                    float r = 0, q = 0;
                    inverse.residual[k].get(r, 1);
                    inverse.product[k].get(q, 2);
                    next[k].put(r - alpha * q, 3);
                }
                __syncthreads();
            }
            if (alpha != 0) from = {inverse.residual + inverse.size + PADDING, 3, 0, 0};
        }
        zr[blockIdx.x * THREADS + threadIdx.x] = mine;
        for (int k = threadIdx.x; k < plan->size; k += THREADS) {
            float z;
            if (inverse.z != body->z) { inverse.z[k].get(z, 3); body->z[k].put(z, 3); }
        }
    }, {{shared_memory, sizeof shared_memory}, {matrix_registers, sizeof matrix_registers}});
}
"""
ASSEMBLY = {  # bodies of functions whose text is for a GPU alone
    "half_of": "_Float16 h = (_Float16)v; unsigned short bits; std::memcpy(&bits, &h, 2); return bits;",
    "of_half": "_Float16 v; std::memcpy(&v, &h, 2); return (float)v;",
    "shared_address": "return (unsigned)((const char*)p - shared_memory);",
    "shared_vector_load": "return *(const uint4*)(shared_memory + from);",
    "shared_pair_load": "return wanted ? *(const uint2*)(shared_memory + from) : uint2{};",
    "chunk_load": "return from[32 * K];",
    "multiply_add": "matrix_product(sum, a0, a1, a2, a3, b0, b1);",
}
MATRIX = """
struct uint2 { unsigned x, y; };
static uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
static int __double2hiint(double a) { return (int)(__double_as_longlong(a) >> 32); }
static float __int_as_float(int a) { return __uint_as_float((unsigned)a); }
static unsigned matrix_registers[32][32][6];
static float half_at(unsigned word, int k) {
    unsigned short bits = (unsigned short)(word >> 16 * k);
    _Float16 v;
    std::memcpy(&v, &bits, 2);
    return (float)v;
}
// mma.m16n8k16: lane 4 g + t has rows g (a0, a2) and g + 8 (a1, a3) of a, columns 2 t, 2 t + 1 (a0, a1)
// and 2 t + 8, 2 t + 9 (a2, a3);
// of b rows 2 t, 2 t + 1 (b0) and 2 t + 8, 2 t + 9 (b1) of column g; of the sum rows g, g + 8, columns 2 t, 2 t + 1.
static void matrix_product(float sum[4], unsigned a0, unsigned a1, unsigned a2, unsigned a3, unsigned b0, unsigned b1) {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, g = lane / 4, t = lane % 4;
    auto& all = matrix_registers[warp];
    const unsigned own[6] = {a0, a1, a2, a3, b0, b1};
    std::memcpy(all[lane], own, sizeof own);
    __syncwarp();
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j)
            for (int k = 0; k < 2; ++k) {
                const int low = i / 2, column = 2 * t + i % 2;
                sum[i] += half_at(all[4 * g + j][low], k) * half_at(all[4 * column + j][4], k) +
                          half_at(all[4 * g + j][2 + low], k) * half_at(all[4 * column + j][5], k);
            }
    __syncwarp();
}
"""


def compiled(folder: Path, form: str) -> c.CDLL:
    gpu = SOURCES / "backends/gpu"
    group, inverse = (gpu / "block_group.cuh").read_text(), (gpu / "inverse/partitioned_inverse.cuh").read_text()
    for pattern_, plain in WORDS:
        group, found = re.subn(pattern_, lambda _, p=plain: p, group, flags=re.DOTALL)
        assert found, pattern_
    for name, body in ASSEMBLY.items():
        whole = rf"(__device__ __forceinline__ [\w ]+ {name}\([^)]*\) )(\{{[^\n]*\}}|\{{\n.*?\n\}})\n"
        inverse, found = re.subn(whole, lambda m, b=body: f"{m[1]}{{ {b} }}\n", inverse, flags=re.DOTALL)
        assert found == 1, name
    assert "asm" not in inverse
    for name, text in {"block_group.cuh": group, "partitioned_inverse.cuh": inverse}.items():
        (folder / name).write_text(text)
    (folder / "inverse.cpp").write_text(f'#include "cuda_threads.h"\n{MORE}{MATRIX}{PARTS}')
    paths = [f"-I{p}" for p in (folder, TESTS / "backends", gpu, INCLUDE)]
    alone = [] if form == "several" else ["ALONE"]
    words = [f"-D{d}" for d in ("real=double", f"THREADS={THREADS[form]}", "PER_PROCESSOR=1", *alone)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-w", *words, *paths]
    subprocess.run([*command, str(folder / "inverse.cpp"), "-o", str(folder / "inverse.so")], check=True)
    library = c.CDLL(str(folder / "inverse.so"))
    library.apply.argtypes = [c.c_void_p, c.c_void_p, c.c_float, c.c_float, c.c_int, c.c_void_p]
    return library


class Host:
    """Arrays stay where they are."""

    class cp:
        zeros = staticmethod(np.zeros)

        @staticmethod
        def asarray(array: NDArray) -> Any:
            kept = np.ascontiguousarray(array)
            return SimpleNamespace(data=SimpleNamespace(ptr=kept.ctypes.data), host=kept)


def applied(library: c.CDLL, form: str, p: Plan, s: Any, shared: int) -> tuple[NDArray, float]:
    """z of r - alpha q, and z . r. alpha: 0 where d r is there after the update alone"""
    alone = form != "several"
    alpha = 0.0 if alone else 0.5
    device = DevicePlan(Host, p)  # type: ignore[arg-type]
    chunks, scale = stored(s.pattern, s.factor, p, np.float16)
    scale = scale.astype(np.float32)
    at = (p.place[:, None] + np.arange(3)).ravel()
    q = np.random.default_rng(3).normal(size=len(s.r)) if alpha else np.zeros(len(s.r))
    word = np.float32 if alone else np.dtype([("value", "<f4"), ("number", "<u4")])
    n = p.size + 32

    def words(count: int, number: int, values: NDArray | None = None) -> NDArray:
        found = np.zeros(count, word)
        if alone:
            found[:] = np.nan if values is None else 0
            if values is not None:
                found[at] = values
        elif values is not None:
            found["number"][at] = number
            found["value"][at] = values
        return found

    vectors = {
        "residual": words(2 * n, 1, scale[at] * (s.r + alpha * q)), "product": words(n, 2, scale[at] * q),
        "z": words(n, 0), "formed": words(n, 0), "solved": words(n, 0), "contributed": words(len(p.slots) + 32, 0),
    }  # fmt: skip
    if alone:  # what padding refers to
        vectors["solved"][p.size :] = 0
    body = np.zeros(1, PCG.dtype("PcgBody"))
    matrix = np.ascontiguousarray(chunks)
    for name, array in {"matrix": matrix, "scale": scale, **vectors}.items():
        body[name] = array.ctypes.data
    body["blocks"], body["planes"] = p.blocks, p.planes
    zr = np.zeros(p.blocks * THREADS[form])
    unit = 2.0 ** -int(np.ceil(np.log2(np.abs(scale[at] * s.r).max() + 1)))
    library.apply(body.ctypes.data, device.address, alpha, unit, shared, zr.ctypes.data)
    z = vectors["z"]
    return (z if alone else z["value"])[at].astype(float), float(zr.sum())


@pytest.fixture(scope="module", params=list(THREADS))
def form(request):
    return request.param


@pytest.fixture(scope="module")
def library(form, tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("inverse"), form)


@pytest.fixture(scope="module")
def problem():
    return system(pattern(4 * 4 * 13, bar_edges(3, 3, 12)))


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("planes", [1, 2])
@pytest.mark.parametrize("groups", [1, 3])
def test_z_is_that_of_numpy(library, form, problem, groups, planes, near):
    s, tree = problem, tree_of(problem.pattern)
    sizes = np.unique(tree.size).tolist()
    thresholds = tuple(sizes[k * len(sizes) // groups] for k in range(1, groups))
    p = lay_out(tree, thresholds, 3 if form == "several" else 1, planes)
    check(library, form, p, s, 120_000 if near else 30_000)


@pytest.mark.parametrize("graph", [(1, []), (30, []), (2 * 2 * 5, bar_edges(1, 1, 4))], ids=["node", "apart", "bar"])
def test_thread_blocks_and_warps_may_have_nothing_to_do(library, form, graph):
    """Of bodies with fewer chunks than warps, and fewer tiles than thread blocks."""
    nodes, edges = graph
    s = system(pattern(nodes, np.reshape(edges, (-1, 2)).astype(int)))
    check(library, form, lay_out(tree_of(s.pattern), (), 5 if form == "several" else 1, 2), s, 30_000)


def check(library: c.CDLL, form: str, p: Plan, s: Any, shared: int) -> None:
    z, zr = applied(library, form, p, s, shared)
    within = 2e-3 if p.planes == 1 else 3e-6
    assert np.linalg.norm(z - s.z) <= within * np.linalg.norm(s.z)
    assert abs(zr - s.r @ z) <= 1e-5 * abs(s.r @ z)
