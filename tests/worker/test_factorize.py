# SPDX-License-Identifier: MIT
"""Numeric factors: L L^T = P A P^T by both libraries, in one pattern whatever the values are."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from precond_worker.factorization.factorize import CHOICE, Analysis, NotPositiveDefinite, default_library
from tests.reference import supernodal
from tests.worker.block_matrices import bar_edges, dense_matrix, diagonal_blocks, pattern, spd

try:
    import sksparse.cholmod  # noqa: F401

    LIBRARIES = ["cholmod", "supernodal"]
except ImportError:
    LIBRARIES = ["supernodal"]

library = pytest.mark.parametrize("library", LIBRARIES)
both = pytest.mark.skipif(len(LIBRARIES) < 2, reason="needs scikit-sparse")

TWO_BARS = np.concatenate([bar_edges(3, 2, 4), bar_edges(2, 2, 2) + 60])
GRAPHS = {
    "bar": pattern(60, bar_edges(3, 2, 4)),
    "bar with a fixed end": pattern(60, bar_edges(3, 2, 4), np.arange(12)),
    "bars with fixed nodes": pattern(60 + 27, TWO_BARS, np.array([0, 7, 13, 61, 86])),
    "one node": pattern(1, np.empty((0, 2))),
    "two nodes": pattern(2, np.array([[0, 1]])),
    "all fixed": pattern(5, np.array([[0, 1], [1, 4]]), np.arange(5)),
    "chain": pattern(40, np.array([[i, i + 1] for i in range(39)])),
    "star": pattern(30, np.array([[11, i] for i in range(30) if i != 11])),
}
graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())


def residual(analysis: Analysis, values: NDArray, matrix: NDArray) -> float:
    """max |L L^T - P A P^T| / max |A|."""
    lower = supernodal.lower(analysis.pattern, values)
    order = analysis.pattern.permutation
    return float(np.abs(lower @ lower.T - matrix[np.ix_(order, order)]).max() / np.abs(matrix).max())


@library
@graphs
def test_the_factor_multiplies_to_the_permuted_matrix(graph, library):
    analysis = Analysis(*graph, library)
    analysis.pattern.check()
    values = spd(*graph, seed=3)
    matrix = dense_matrix(*graph, values)
    assert residual(analysis, analysis.factorize(values, np.float64), matrix) < 1e-12
    single = analysis.factorize(values, np.float32)
    assert single.dtype == np.float32
    assert single.shape == (analysis.pattern.nonzeros,)
    assert residual(analysis, single, matrix) < 1e-6


@library
@graphs
def test_the_packed_factor_solves(graph, library):
    analysis = Analysis(*graph, library)
    values = spd(*graph, seed=4)
    x = np.random.default_rng(5).normal(size=analysis.pattern.size)
    b = dense_matrix(*graph, values) @ x
    np.testing.assert_allclose(
        supernodal.solve(analysis.pattern, analysis.factorize(values, np.float64), b), x, rtol=1e-9
    )


@library
def test_zeros_among_the_values_move_nothing(library):
    graph = GRAPHS["bars with fixed nodes"]
    analysis = Analysis(*graph, library)
    for seed, zeros in enumerate((0.0, 0.5, 1.0, 0.9, 0.0)):
        values = spd(*graph, seed=seed, zeros=zeros)
        factor = analysis.factorize(values, np.float64)
        assert factor.shape == (analysis.pattern.nonzeros,)
        assert residual(analysis, factor, dense_matrix(*graph, values)) < 1e-12


@library
def test_the_same_values_give_the_same_bits(library):
    graph = GRAPHS["bars with fixed nodes"]
    analysis, again = Analysis(*graph, library), Analysis(*graph, library)
    first, other = spd(*graph, seed=1), spd(*graph, seed=2)
    reference = analysis.factorize(first, np.float64).copy()
    analysis.factorize(other, np.float64)
    assert analysis.factorize(first, np.float64).tobytes() == reference.tobytes()
    assert again.factorize(first, np.float64).tobytes() == reference.tobytes()


@both
@graphs
def test_both_libraries_give_the_same_factor_in_the_same_pattern(graph):
    cholmod, ours = Analysis(*graph, "cholmod"), Analysis(*graph, "supernodal")
    assert cholmod.pattern.id == ours.pattern.id
    values = spd(*graph, seed=6, zeros=0.3)
    np.testing.assert_allclose(cholmod.factorize(values, np.float64), ours.factorize(values, np.float64), atol=1e-12)


@both
@graphs
def test_cholmod_merges_columns_as_the_pattern_says(graph):
    """Otherwise its values would have to be looked up one by one: right, but slower."""
    from precond_worker.factorization.cholmod import CholmodFactorization

    cholmod = CholmodFactorization(*graph)
    assert cholmod.packer.is_packed(cholmod.numeric.factorize(spd(*graph)))


@both
def test_cholmod_merges_columns_of_a_large_bar_as_the_pattern_says():
    from precond_worker.factorization.cholmod import CholmodFactorization

    graph = pattern(756, bar_edges(5, 5, 20), np.arange(36))  # 3000 tetrahedra
    analysis = Analysis(*graph, "cholmod")
    assert np.diff(analysis.pattern.super_start).max() > 48  # panels of all widths that the rule tells apart
    identity = np.zeros((len(graph[1]), 3, 3))
    identity[diagonal_blocks(*graph)] = np.eye(3)
    cholmod = CholmodFactorization(*graph)
    assert cholmod.packer.is_packed(cholmod.numeric.factorize(identity))
    assert np.count_nonzero(analysis.factorize(identity)) == analysis.pattern.size


@library
def test_only_one_of_mirrored_values_is_read(library):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    values = spd(*graph)
    rows = np.repeat(np.arange(60), np.diff(graph[0]))
    rank = np.argsort(analysis.pattern.permutation[::3] // 3)
    changed = values.copy()
    changed[rank[rows] < rank[graph[1]]] = 7.0
    changed[diagonal_blocks(*graph), 0, 2] = 7.0
    assert np.array_equal(analysis.factorize(changed), analysis.factorize(values))


@library
@pytest.mark.parametrize("node", [0, 20, 59])
def test_an_indefinite_matrix_is_named_and_the_next_one_is_fine(node, library):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    values = spd(*graph)
    expected = analysis.factorize(values)
    bad = values.copy()
    bad[diagonal_blocks(*graph)[node], 1, 1] *= -1
    with pytest.raises(NotPositiveDefinite, match=f"not positive definite .*node {node}, axis y"):
        analysis.factorize(bad)
    assert np.array_equal(analysis.factorize(values), expected)


@library
@pytest.mark.parametrize("shift", [0.0, -1e-300])
def test_a_matrix_without_definite_pivots_is_refused(shift, library):
    graph = GRAPHS["two nodes"]
    values = np.ones((4, 3, 3))
    values[diagonal_blocks(*graph)] += shift * np.eye(3)
    with pytest.raises(NotPositiveDefinite):
        Analysis(*graph, library).factorize(values)
    with pytest.raises(NotPositiveDefinite):
        Analysis(*graph, library).factorize(np.zeros((4, 3, 3)))


@library
def test_a_zero_on_the_diagonal_is_refused(library):
    graph = GRAPHS["chain"]
    values = spd(*graph)
    values[diagonal_blocks(*graph), 2, 2] = 0
    with pytest.raises(NotPositiveDefinite):
        Analysis(*graph, library).factorize(values)


@library
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(value, library):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    values = spd(*graph)
    values[17, 0, 2] = value
    with pytest.raises(ValueError, match="finite"):
        analysis.factorize(values)


@library
@pytest.mark.parametrize("scale", [1e80, 1e-80])
def test_a_factor_out_of_the_range_of_float32_is_refused_there_only(scale, library):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    values = spd(*graph) * scale
    assert residual(analysis, analysis.factorize(values, np.float64), dense_matrix(*graph, values)) < 1e-12
    with pytest.raises(NotPositiveDefinite, match="float32"):
        analysis.factorize(values, np.float32)


@library
def test_the_factor_goes_where_it_is_wanted(library):
    graph = GRAPHS["bar"]
    analysis = Analysis(*graph, library)
    values = spd(*graph)
    out = np.full(analysis.pattern.nonzeros, np.nan, np.float32)
    assert analysis.factorize(values, out=out) is out
    assert np.array_equal(out, analysis.factorize(values, np.float32))


def test_wrong_shapes_and_types_are_named():
    graph = GRAPHS["two nodes"]
    analysis = Analysis(*graph)
    with pytest.raises(ValueError, match=r"\(3, 3, 3\), allowed: \(4, 3, 3\)"):
        analysis.factorize(np.ones((3, 3, 3)))
    with pytest.raises(ValueError, match="float16, allowed: float32, float64"):
        analysis.factorize(spd(*graph), np.float16)
    with pytest.raises(ValueError, match=r"out of shape \(3,\), allowed: \(21,\)"):
        analysis.factorize(spd(*graph), out=np.empty(3))
    with pytest.raises(ValueError, match="'umfpack', allowed: auto, cholmod, supernodal, gpu"):
        Analysis(*graph, "umfpack")


def test_the_environment_chooses_the_library(monkeypatch):
    graph = GRAPHS["two nodes"]
    monkeypatch.setenv(CHOICE, "supernodal")
    assert default_library() == Analysis(*graph).library == "supernodal"
    monkeypatch.setenv(CHOICE, "pardiso")
    with pytest.raises(ValueError, match="pardiso, allowed: cholmod, supernodal"):
        default_library()


def test_our_own_is_the_default_also_where_scikit_sparse_is(monkeypatch):
    """Which is asked for by its name, and told to be missing then."""
    graph = GRAPHS["two nodes"]
    monkeypatch.delenv(CHOICE, raising=False)
    assert default_library() == Analysis(*graph).library == "supernodal"
    monkeypatch.setenv(CHOICE, "cholmod")
    assert default_library() == "cholmod"
    for module in ("sksparse", "sksparse.cholmod"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "precond_worker.factorization.cholmod", raising=False)
    with pytest.raises(ImportError):
        Analysis(*graph)


@st.composite
def small_graphs(draw: st.DrawFn) -> tuple[NDArray, NDArray]:
    nodes = draw(st.integers(1, 14))
    node = st.integers(0, nodes - 1)
    edges = draw(st.lists(st.tuples(node, node).filter(lambda edge: edge[0] != edge[1]), max_size=40))
    fixed = draw(st.lists(node, max_size=3))
    return pattern(nodes, np.array(edges, np.int64).reshape(-1, 2), np.array(fixed, np.int64))


@pytest.mark.parametrize("library", LIBRARIES)
@settings(max_examples=60, deadline=None)
@given(graph=small_graphs(), seed=st.integers(0, 1000), zeros=st.sampled_from([0.0, 0.5, 1.0]))
def test_any_small_graph_is_factorized(library, graph, seed, zeros):
    analysis = Analysis(*graph, library)
    values = spd(*graph, seed=seed, zeros=zeros)
    matrix = dense_matrix(*graph, values)
    factor = analysis.factorize(values, np.float64)
    assert residual(analysis, factor, matrix) < 1e-12
    x = supernodal.solve(analysis.pattern, factor, matrix[:, 0])
    np.testing.assert_allclose(x, np.eye(len(x))[0], atol=1e-9)
