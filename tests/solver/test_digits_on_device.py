# SPDX-License-Identifier: MIT
"""The estimate of binary digits by the kernels of a GPU (digits.cu), run on the processor, beside native code."""

import ctypes as c
import subprocess
from pathlib import Path

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from precond_worker.gpu.assembly_tree import assembly_tree
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from protocol.factor import FactorPattern
from sim_server.backends.compiler import SOURCES, compiler
from sim_server.backends.gpu.device import PRECISIONS, options, own_headers
from sim_server.backends.gpu.inverse.device_digits import (
    DIGITS,
    PROBES,
    places_of_rows,
    supernode_table,
    tasks_of_rows,
)
from sim_server.backends.gpu.inverse.digits import largest_responses
from tests.support import nvrtc
from tests.worker.block_matrices import bar_edges, pattern, spd

TEXT = SOURCES / "backends/gpu/inverse/digits.cu"
ON_THREADS = """
#include "cuda_threads.h"
struct float4 { float x, y, z, w; };
static float4 __ldcg(const float4* a) { return *a; }
static void __nanosleep(unsigned) { give_turn(); }
#undef __shared__
#define __shared__ __attribute__((section("own"))) static  // what a thread block has by itself
#include "digits.cu"
extern char __start_own[], __stop_own[];
extern "C" double largest(int blocks, const Supernode* supernodes, int count, const int* rows, const float* values,
                          float* y, int* state, const RowsOfSupernode* tasks, int task_count, float* squares, int n,
                          const int* start, const int* list) {
    long long found = 0;
    auto solve = [&] { solve_probes(supernodes, count, rows, values, (float4*)y, state); };
    launch_together(blocks, THREADS, solve, {{__start_own, size_t(__stop_own - __start_own)}});
    launch(blocks, ROWS, [&] { square_rows(tasks, task_count, supernodes, values, squares); });
    launch(blocks, 256, [&] { find_largest(n, start, list, squares, y, &found); });
    return __longlong_as_double(found);
}
"""


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("digits")
    (folder / "digits.cpp").write_text(ON_THREADS)
    paths = [f"-I{p}" for p in (Path(__file__).parents[1] / "backends", TEXT.parent)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-w", *paths, str(folder / "digits.cpp")]
    subprocess.run([*command, "-o", str(folder / "digits.so")], check=True)
    library = c.CDLL(str(folder / "digits.so"))
    library.largest.restype = c.c_double
    return library


def on_device(kernels: c.CDLL, shape: FactorPattern, values: np.ndarray, blocks: int) -> float:
    table, tasks = supernode_table(shape), tasks_of_rows(shape)
    start, places = places_of_rows(shape)
    y, squares = np.full(PROBES * shape.size, np.nan, np.float32), np.full(len(shape.rows), np.nan, np.float32)
    state = np.zeros(1 + len(table), np.int32)
    at = (c.c_void_p(a.ctypes.data) for a in (table, shape.rows, values, y, state, tasks, squares, start, places))
    table_at, rows, values_at, y_at, state_at, tasks_at, squares_at, start_at, places_at = at
    return float(
        kernels.largest(
            blocks, table_at, len(table), rows, values_at, y_at, state_at, tasks_at, len(tasks), squares_at, shape.size,
            start_at, places_at,
        )
    )  # fmt: skip


def graph_of(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    nodes = int(np.prod(np.add(cells, 1)))
    return pattern(nodes, bar_edges(*cells), np.arange((cells[0] + 1) * (cells[1] + 1)))


def of_cpu(cells: tuple[int, int, int], seed: int) -> tuple[FactorPattern, np.ndarray]:
    graph = graph_of(cells)
    analysis = Analysis(*graph)
    return analysis.pattern, analysis.factorize(spd(*graph, seed=seed), np.float32)


def like_a_gpu_worker(cells: tuple[int, int, int], seed: int) -> tuple[FactorPattern, np.ndarray]:
    """Large supernodes with explicit zeros, and any values."""
    graph = graph_of(cells)
    shape = FactorPattern.build(**assembly_tree(eliminate(*graph, order_nodes(*graph))).pattern_arrays())
    rng = np.random.default_rng(seed)
    values = rng.normal(scale=0.05, size=shape.nonzeros).astype(np.float32)
    values[shape.diagonal] = rng.uniform(1, 2, shape.size)
    return shape, values


@pytest.mark.parametrize("blocks", [1, 2])
@pytest.mark.parametrize("made", [of_cpu, like_a_gpu_worker])
def test_it_is_that_of_the_host(kernels: c.CDLL, made, blocks: int) -> None:
    shape, values = made((3, 3, 6), 1)
    assert on_device(kernels, shape, values, blocks) == pytest.approx(largest_responses(shape, [values])[0], rel=1e-4)


def test_supernodes_wider_than_what_is_solved_together(kernels: c.CDLL) -> None:
    shape, values = like_a_gpu_worker((4, 4, 6), 2)
    assert np.diff(shape.super_start).max() > 64
    assert on_device(kernels, shape, values, 2) == pytest.approx(largest_responses(shape, [values])[0], rel=1e-4)


def test_it_is_the_same_to_the_bit_with_two_thread_blocks(kernels: c.CDLL) -> None:
    shape, values = of_cpu((3, 3, 6), 3)
    assert len({on_device(kernels, shape, values, blocks) for blocks in (1, 2)}) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_shows(kernels: c.CDLL, bad: float) -> None:
    shape, values = of_cpu((2, 2, 3), 4)
    values[shape.nonzeros // 2] = bad
    assert not on_device(kernels, shape, values, 1) <= 400


def test_it_compiles_for_gpus(tmp_path: Path) -> None:
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    text = tmp_path / "digits.cu"
    text.write_text(TEXT.read_text() + DIGITS.assertions())
    code, said = nvrtc.compiled(library, text, [*options(PRECISIONS["float64"]), *own_headers(), "-arch=sm_90"])
    assert code and not said, said
