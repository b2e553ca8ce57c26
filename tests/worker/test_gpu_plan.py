# SPDX-License-Identifier: MIT
"""Fronts for a GPU: the plan carried out in NumPy gives the Cholesky factor, in a pattern that the protocol takes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from precond_worker.gpu.assembly_tree import WIDTH, AssemblyTree, assembly_tree
from precond_worker.gpu.copies import copies
from precond_worker.gpu.plan import MultifrontalPlan, levels, make_plan
from precond_worker.symbolic.elimination import eliminate
from precond_worker.symbolic.ordering import order_nodes
from precond_worker.symbolic.supernodes import fundamental_supernodes, relaxed_supernodes
from protocol.factor import FactorPattern
from tests.reference import multifrontal, supernodal
from tests.worker.block_matrices import GRAPHS, dense_matrix, pattern, spd

graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())


def made(graph: tuple[NDArray, NDArray]) -> tuple[AssemblyTree, FactorPattern, MultifrontalPlan]:
    tree = assembly_tree(eliminate(*graph, order_nodes(*graph)))
    return tree, FactorPattern.build(**tree.pattern_arrays()), make_plan(tree, *graph)


def residual(factor_pattern: FactorPattern, factor: NDArray, matrix: NDArray) -> float:
    lower = supernodal.lower(factor_pattern, factor)
    order = factor_pattern.permutation
    return float(np.abs(lower @ lower.T - matrix[np.ix_(order, order)]).max() / np.abs(matrix).max())


@graphs
def test_the_plan_leads_to_the_factor(graph):
    _, factor_pattern, plan = made(graph)
    values = spd(*graph, seed=5)
    factor = multifrontal.factorize(plan, values)
    assert factor.shape == (factor_pattern.nonzeros,)
    assert residual(factor_pattern, factor, dense_matrix(*graph, values)) < 1e-12


@graphs
def test_solutions_are_those_of_the_cpu(graph):
    _, factor_pattern, plan = made(graph)
    values = spd(*graph, seed=6)
    b = np.random.default_rng(1).normal(size=factor_pattern.size)
    cpu = Analysis(*graph)
    expected = supernodal.solve(cpu.pattern, cpu.factorize(values, np.float64), b)
    np.testing.assert_allclose(supernodal.solve(factor_pattern, multifrontal.factorize(plan, values), b), expected)


@graphs
def test_copies_of_a_pattern_are_factorized_as_if_each_were_alone(graph):
    """Bit by bit, in the order of the copies."""
    tree, factor_pattern, plan = made(graph)
    many = copies(tree, *graph, 3)
    values = [spd(*graph, seed=seed) for seed in (5, 6, 7)]
    found = multifrontal.factorize(make_plan(many.tree, many.row_start, many.columns), np.concatenate(values))
    assert found.shape == (3 * factor_pattern.nonzeros,)
    for factor, matrix in zip(found.reshape(3, -1), values, strict=True):
        assert np.array_equal(factor, multifrontal.factorize(plan, matrix))


def test_only_one_of_mirrored_values_is_read_the_same_as_on_the_cpu():
    graph = GRAPHS["bar"]
    _, factor_pattern, plan = made(graph)
    values = spd(*graph)
    rank = np.argsort(factor_pattern.permutation[::3] // 3)
    rows = np.repeat(np.arange(len(rank)), np.diff(graph[0]))
    changed = values.copy()
    changed[rank[rows] < rank[graph[1]]] = 7.0
    changed[rows == graph[1], 0, 2] = 7.0
    assert np.array_equal(multifrontal.factorize(plan, changed), multifrontal.factorize(plan, values))


@graphs
def test_fronts_are_fewer_than_supernodes_and_keep_the_fill(graph):
    order = order_nodes(*graph)
    elimination = eliminate(*graph, order)
    tree, factor_pattern, _ = made(graph)
    assert len(tree.parent) <= len(fundamental_supernodes(elimination))
    again = eliminate(*graph, tree.order)
    assert again.count.sum() == elimination.count.sum(), "the order of the merged tree has the same fill"
    assert factor_pattern.nonzeros <= 2 * 9 * elimination.count.sum()


def test_small_fronts_join_across_siblings():
    """More than the CPU's rule can do, which leaves the order alone and so merges a chain of last children at most."""
    graph = GRAPHS["bar"]
    elimination = eliminate(*graph, order_nodes(*graph))
    tree, _, plan = made(graph)
    assert len(tree.parent) < 0.7 * len(relaxed_supernodes(elimination))
    assert (np.diff(plan.child_start) >= 2).any()
    assert not np.array_equal(tree.order, elimination.order)
    assert (tree.own * 3 > WIDTH).any(), "and some are eliminated in several steps"


@graphs
def test_levels_put_every_front_right_under_its_parent(graph):
    tree, _, plan = made(graph)
    level = levels(tree)
    children = np.flatnonzero(tree.parent >= 0)
    assert np.array_equal(level[children] + 1, level[tree.parent[children]])
    assert plan.levels == level.max() + 1
    assert np.array_equal(np.bincount(level), np.diff(plan.level_start))
    for i in range(plan.levels):
        assert (np.diff(plan.own[plan.fronts(i)]) <= 0).all(), "the widest first: a step takes in the first few"


@graphs
def test_fronts_of_a_level_do_not_overlap(graph):
    _, _, plan = made(graph)
    for i in range(plan.levels):
        at, size = plan.at[plan.fronts(i)], (plan.stride * plan.rows)[plan.fronts(i)]
        assert np.array_equal(at, np.concatenate([[0], np.cumsum(size)[:-1]]))
        assert at[-1] + size[-1] <= plan.half[i % 2]


@st.composite
def small_graphs(draw: st.DrawFn) -> tuple[NDArray, NDArray]:
    nodes = draw(st.integers(1, 40))
    node = st.integers(0, nodes - 1)
    edges = draw(st.lists(st.tuples(node, node).filter(lambda edge: edge[0] != edge[1]), max_size=80))
    fixed = draw(st.lists(node, max_size=3))
    return pattern(nodes, np.array(edges, np.int64).reshape(-1, 2), np.array(fixed, np.int64))


@settings(max_examples=60, deadline=None)
@given(graph=small_graphs(), seed=st.integers(0, 1000), zeros=st.sampled_from([0.0, 0.5, 1.0]))
def test_any_small_graph_is_factorized(graph, seed, zeros):
    _, factor_pattern, plan = made(graph)
    values = spd(*graph, seed=seed, zeros=zeros)
    factor = multifrontal.factorize(plan, values)
    assert residual(factor_pattern, factor, dense_matrix(*graph, values)) < 1e-12
