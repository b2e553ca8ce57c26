# SPDX-License-Identifier: MIT
"""backends/cpu/native/supernodal.h: z = P^T L^-T L^-1 P r, against the plain reference and SciPy."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from tests.reference import supernodal
from tests.scenes import bar, factor_of, simulation
from tests.solver.solves import applied
from tests.worker.block_matrices import bar_edges, dense_matrix, pattern, spd

GRAPHS = {
    "bar": pattern(60, bar_edges(3, 2, 4)),
    "bar with a fixed end": pattern(60, bar_edges(3, 2, 4), np.arange(12)),
    "one node": pattern(1, np.empty((0, 2), int)),
    "all fixed": pattern(5, np.array([[0, 1], [1, 4]]), np.arange(5)),
    "chain": pattern(40, np.array([[i, i + 1] for i in range(39)])),
    "star": pattern(30, np.array([[11, i] for i in range(30) if i != 11])),
    "complete": pattern(12, np.array([[i, j] for i in range(12) for j in range(i)])),
}
graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())


def assert_solves(graph: tuple[NDArray, NDArray], seed: int) -> None:
    """Both precisions against the reference, float64 against a dense solve with the matrix itself."""
    analysis = Analysis(*graph)
    values = spd(*graph, seed=seed)
    matrix = dense_matrix(*graph, values)
    r = np.random.default_rng(seed).normal(size=len(matrix))
    exact = np.linalg.solve(matrix, r)
    for dtype, bound in ((np.float64, 1e-12), (np.float32, 1e-5)):
        factor = analysis.factorize(values, dtype)
        z = applied(analysis.pattern, factor)(r)
        reference = supernodal.solve(analysis.pattern, factor, r)
        assert np.linalg.norm(z - reference) <= bound * np.linalg.norm(reference)
        assert np.linalg.norm(z - exact) <= 100 * bound * np.linalg.norm(exact)


@graphs
def test_it_solves(graph):
    assert_solves(graph, seed=4)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 25), st.data())
def test_it_solves_on_any_graph(nodes, data):
    ends = st.tuples(st.integers(0, nodes - 1), st.integers(0, nodes - 1)).filter(lambda e: e[0] != e[1])
    edges = data.draw(st.lists(ends, max_size=4 * nodes)) if nodes > 1 else []
    fixed = np.array(data.draw(st.lists(st.integers(0, nodes - 1), max_size=3)), int)
    assert_solves(pattern(nodes, np.array(edges).reshape(-1, 2), fixed), seed=data.draw(st.integers(0, 5)))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_it_solves_with_any_legal_pattern(data):
    """Supernodes of all widths and heights, with gaps, as a worker of somebody else's might send."""
    widths = data.draw(st.lists(st.integers(1, 11), min_size=1, max_size=6))
    n, random = sum(widths), np.random.default_rng(data.draw(st.integers(0, 1000)))
    start = np.concatenate([[0], np.cumsum(widths)])
    rows, row_start = [], [0]
    for c0, c1 in itertools.pairwise(start):
        below = np.arange(c1, n)[random.random(n - c1) < 0.5]
        rows += [*range(c0, c1), *below]
        row_start.append(len(rows))
    legal = FactorPattern.build(random.permutation(n), start, row_start, rows)
    values = random.normal(size=legal.nonzeros) / np.sqrt(n)
    values[legal.diagonal] = 1 + random.random(n)
    r = random.normal(size=n)
    L = supernodal.lower(legal, values)
    expected = np.empty(n)
    expected[legal.permutation] = np.linalg.solve(L @ L.T, r[legal.permutation])
    for dtype, bound in ((np.float64, 1e-10), (np.float32, 1e-2)):
        z = applied(legal, values.astype(dtype))(r)
        assert np.linalg.norm(z - supernodal.solve(legal, values, r)) <= bound * np.linalg.norm(expected)
        assert np.linalg.norm(z - expected) <= bound * np.linalg.norm(expected)


def test_it_solves_the_system_of_a_step():
    sim = simulation(bar((8, 4, 4), (2, 1, 1), young=1e6, fixed="X < 0.01"))
    sim.engine.assemble()
    r = np.random.default_rng(0).normal(size=3 * sim.world.nodes)
    exact = spsolve(sim.matrix(), r)
    for dtype, bound in ((np.float64, 1e-12), (np.float32, 1e-4)):
        z = applied(*factor_of(sim, dtype=dtype))(r)
        assert np.linalg.norm(z - exact) < bound * np.linalg.norm(exact)


def test_it_is_symmetric_and_positive():
    """Conjugate gradients need a symmetric positive definite preconditioner; in single precision up to its rounding."""
    sim = simulation(bar((4, 2, 2), young=1e6, fixed="X < 0.01"))
    sim.engine.assemble()
    random = np.random.default_rng(1)
    for dtype, bound in ((np.float64, 1e-13), (np.float32, 1e-5)):
        apply = applied(*factor_of(sim, dtype=dtype))
        for _ in range(10):
            a, b = random.normal(size=(2, 3 * sim.world.nodes))
            scale = np.sqrt((a @ apply(a)) * (b @ apply(b)))
            assert abs(a @ apply(b) - b @ apply(a)) < bound * scale
            assert a @ apply(a) > 0
