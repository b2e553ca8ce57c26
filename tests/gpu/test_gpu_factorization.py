# SPDX-License-Identifier: MIT
"""Factors made on a GPU beside those of the CPU. Runs where there is a GPU: pytest -m gpu."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix

from precond_worker.factorization.factorize import Analysis, NotPositiveDefinite
from precond_worker.many import GivenMatrices, Made
from protocol.factor import FactorPattern
from sim_server.simulation import Simulation
from tests.reference import supernodal
from tests.worker.block_matrices import GRAPHS as COMMON
from tests.worker.block_matrices import bar_edges, dense_matrix, diagonal_blocks, pattern, spd

pytestmark = pytest.mark.gpu

GRAPHS = COMMON | {
    "bar": pattern(9 * 9 * 13, bar_edges(8, 8, 12)),
    "dense": pattern(60, np.array([[i, j] for i in range(60) for j in range(i)])),
}
graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())
arithmetic = pytest.mark.parametrize("library", ["gpu-float64", "gpu-float32"])


def sparse(factor_pattern: FactorPattern, values: NDArray) -> csc_matrix:
    """L, in float64."""
    columns = list(supernodal.columns(factor_pattern, values))
    start = np.concatenate([[0], np.cumsum([len(rows) for rows, _ in columns])])
    rows = np.concatenate([rows for rows, _ in columns])
    return csc_matrix((values.astype(np.float64), rows, start), shape=(factor_pattern.size,) * 2)


def error(analysis: Analysis, values: NDArray, graph: tuple[NDArray, NDArray], matrix: NDArray) -> float:
    """|L L^T - P A P^T| / |A| in the Frobenius norm."""
    lower = sparse(analysis.pattern, values)
    order = analysis.pattern.permutation
    a = csc_matrix(bsr_matrix((matrix, graph[1], graph[0])))[order][:, order]
    difference = lower @ lower.T - a
    return float(np.sqrt((difference.multiply(difference)).sum() / a.multiply(a).sum()))


@graphs
@arithmetic
def test_the_factor_multiplies_to_the_permuted_matrix(graph, library):
    analysis = Analysis(*graph, library)
    matrix = spd(*graph, seed=3)
    single = analysis.factorize(matrix, np.float32)
    assert single.dtype == np.float32 and single.shape == (analysis.pattern.nonzeros,)
    assert error(analysis, single, graph, matrix) < 1e-6
    double = analysis.factorize(matrix, np.float64)
    assert double.dtype == np.float64
    assert error(analysis, double, graph, matrix) < 1e-14


@pytest.mark.parametrize("overrides", [[], ["object.beam.mesh.bar=[8, 8, 30]", "dt=0.03"]], ids=["beam", "larger"])
@arithmetic
def test_elastic_bodies_are_factorized_as_on_the_cpu(overrides, library):
    sim = Simulation.load("deploy/scenes/beam.toml", ["solver.preconditioner=none", *overrides])
    sim.engine.run(3)
    row_start, columns = sim.system.body_pattern(0, sim.world.nodes)
    matrix = sim.system.body_values(0, sim.world.nodes)
    gpu, cpu = Analysis(row_start, columns, library), Analysis(row_start, columns)
    values = gpu.factorize(matrix)
    assert error(gpu, values, (row_start, columns), matrix) < 1e-6
    b = np.random.default_rng(1).normal(size=gpu.pattern.size)
    x = supernodal.solve(gpu.pattern, values, b)
    expected = supernodal.solve(cpu.pattern, cpu.factorize(matrix, np.float64), b)
    assert np.linalg.norm(x - expected) < 1e-3 * np.linalg.norm(expected)


def begun(analysis: Analysis, matrices: list[NDArray]) -> Callable[[], Made]:
    """Begins to factorize matrices together; what is returned waits for it."""
    made = analysis.begin_many(GivenMatrices(matrices))
    assert made is not None and made.beside
    return made.end


@pytest.mark.parametrize("graph", [GRAPHS["bar"], COMMON["chain"]], ids=["bar", "chain"])
@arithmetic
def test_many_together_are_to_the_bit_those_one_by_one(graph, library):
    """In any number; one that is not positive definite is told, and the next ones are not spoilt by it."""
    analysis = Analysis(*graph, library)
    matrices = [spd(*graph, seed=seed) for seed in range(5)]
    one_by_one = [analysis.factorize(matrix).copy() for matrix in matrices]
    assert analysis.most >= 5
    for count in (2, 5, 3, 1):
        together = begun(analysis, matrices[:count])()
        assert together.good.tolist() == [True] * count
        assert all(map(np.array_equal, together.values, one_by_one))
    assert not begun(analysis, [matrices[0], -matrices[1], matrices[2]])().good.any()
    assert not begun(analysis, [matrices[0], np.full_like(matrices[1], np.nan)])().good.any()
    together = begun(analysis, matrices[3:])()
    assert together.good.all() and all(map(np.array_equal, together.values, one_by_one[3:]))


@arithmetic
def test_two_may_be_under_way(library):
    """Neither changes what the other returns, also where one of them has no factor."""
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    matrices = [spd(*graph, seed=seed) for seed in range(6)]
    one_by_one = [analysis.factorize(matrix).copy() for matrix in matrices]
    first, second = begun(analysis, matrices[:3]), begun(analysis, matrices[3:])
    for end, expected in ((first, one_by_one[:3]), (second, one_by_one[3:])):
        assert all(map(np.array_equal, end().values, expected))
    spoilt, good = begun(analysis, [matrices[0], -matrices[1]]), begun(analysis, matrices[4:])
    assert not spoilt().good.any() and all(map(np.array_equal, good().values, one_by_one[4:]))
    again = begun(analysis, matrices[2:4]), begun(analysis, matrices[:2])
    assert all(map(np.array_equal, again[0]().values, one_by_one[2:4]))
    assert all(map(np.array_equal, again[1]().values, one_by_one[:2]))


@arithmetic
def test_the_same_matrix_gives_the_same_bits(library):
    graph = GRAPHS["bar"]
    matrix = spd(*graph)
    first, second = (Analysis(*graph, library) for _ in range(2))
    values = first.factorize(matrix)
    assert all(np.array_equal(first.factorize(matrix), values) for _ in range(5))
    assert np.array_equal(second.factorize(matrix), values)


@pytest.mark.parametrize("node", [0, 20, 59])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_indefinite_matrix_is_named_as_on_the_cpu_and_the_next_one_is_fine(node, axis):
    graph = GRAPHS["bar with a fixed end"]
    analysis = Analysis(*graph, "gpu")
    matrix = spd(*graph)
    expected = analysis.factorize(matrix)
    bad = matrix.copy()
    bad[diagonal_blocks(*graph)[node], axis, axis] *= -1
    said = []
    for each in (analysis, Analysis(*graph)):
        with pytest.raises(NotPositiveDefinite) as caught:
            each.factorize(bad)
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert f"node {node}, axis {'xyz'[axis]}" in said[0]
    assert np.array_equal(analysis.factorize(matrix), expected)


def test_a_matrix_of_zeros_is_refused():
    graph = GRAPHS["bar"]
    with pytest.raises(NotPositiveDefinite, match="pivot not positive"):
        Analysis(*graph, "gpu").factorize(np.zeros((len(graph[1]), 3, 3)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(value):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, "gpu")
    matrix = spd(*graph)
    matrix[17, 0, 2] = value
    with pytest.raises(ValueError, match="finite"):
        analysis.factorize(matrix)


@pytest.mark.parametrize("scale", [1e80, 1e-80])
def test_a_factor_out_of_the_range_of_float32_is_refused_there_only(scale):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, "gpu-float64")
    matrix = spd(*graph) * scale
    assert error(analysis, analysis.factorize(matrix, np.float64), graph, matrix) < 1e-14
    with pytest.raises(NotPositiveDefinite, match="float32"):
        analysis.factorize(matrix, np.float32)


def test_the_factor_goes_where_it_is_wanted_and_stays_there():
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, "gpu")
    matrix = spd(*graph)
    out = np.full(analysis.pattern.nonzeros, np.nan, np.float32)
    assert analysis.factorize(matrix, out=out) is out
    kept = analysis.factorize(matrix)
    other = analysis.factorize(4 * matrix)
    assert np.array_equal(out, kept), "later factors leave it alone"
    assert np.allclose(other, 2 * kept)


@pytest.fixture
def locked() -> Iterator[list[int]]:
    """Bytes of each block of page-locked memory that is taken from now on, of an empty pool."""
    from precond_worker.gpu.device import cupy

    cuda, sizes = cupy().cuda, list[int]()

    def lock(size):
        sizes.append(size)
        return cuda.PinnedMemoryPointer(cuda.PinnedMemory(size), 0)

    pool = cuda.PinnedMemoryPool(lock)
    cuda.set_pinned_memory_allocator(pool.malloc)
    yield sizes
    cuda.set_pinned_memory_allocator(cupy().get_default_pinned_memory_pool().malloc)


def test_nothing_is_allocated_once_it_runs(locked):
    """As in a worker, where a factor is sent while the next one is made."""
    from precond_worker.gpu.device import cupy

    cp = cupy()
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, "gpu")
    matrix = spd(*graph)
    analysis.make_ready()
    asked: list[int] = []  # bytes that this process asked its pool or the device for; others may work on the device

    class Hook(cp.cuda.MemoryHook):
        name = "requests"

        def alloc_preprocess(self, **request):
            asked.append(request["mem_size"])

        def malloc_preprocess(self, **request):
            asked.append(request["mem_size"])

    before = locked.copy()
    assert before, "the pool tells what it takes"
    with Hook():
        for _ in range(50):
            sent = analysis.factorize(matrix)
        assert asked == [] and locked == before
        cp.empty(1000)
    assert asked, "the hook hears of what this process allocates"
    assert np.isfinite(sent).all()


def test_too_little_memory_is_said_with_sizes_and_the_rest_goes_on(monkeypatch):
    from precond_worker.gpu.device import cupy

    graph = GRAPHS["bar"]
    runtime = cupy().cuda.runtime
    fine, small = Analysis(*graph, "gpu"), Analysis(*graph, "gpu")
    matrix = spd(*graph)
    values = fine.factorize(matrix)
    pool = cupy().get_default_memory_pool()
    with monkeypatch.context() as patch:
        patch.setattr(
            runtime, "memGetInfo", lambda: (1000 - pool.free_bytes(), 1 << 34)
        )  # what the pool has counts too
        with pytest.raises(MemoryError, match=r"GPU memory: this object needs 0\.\d\d GiB, 0\.00 of 16\.0 GiB"):
            small.factorize(matrix)
        assert np.array_equal(fine.factorize(matrix), values)
    assert np.array_equal(small.factorize(matrix), values)


def test_dense_solutions_agree():
    graph = GRAPHS["bars with fixed nodes"]
    matrix = spd(*graph, seed=9)
    analysis = Analysis(*graph, "gpu")
    b = np.random.default_rng(2).normal(size=analysis.pattern.size)
    x = supernodal.solve(analysis.pattern, analysis.factorize(matrix, np.float64), b)
    np.testing.assert_allclose(x, np.linalg.solve(dense_matrix(*graph, matrix), b), rtol=1e-9, atol=1e-12)
