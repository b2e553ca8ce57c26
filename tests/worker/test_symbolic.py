# SPDX-License-Identifier: MIT
"""Ordering, elimination tree, supernodes, and the refusal of patterns that are none."""

import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from precond_worker.factorization.factorize import Analysis
from precond_worker.factorization.to_supernodal import Packer
from precond_worker.symbolic import ordering
from precond_worker.symbolic.elimination import column_structures, columns_of, eliminate, native_columns, postorder
from precond_worker.symbolic.supernodes import ZEROS_BY_WIDTH, fundamental_supernodes, relaxed_supernodes
from tests.reference import supernodal
from tests.worker.block_matrices import bar_edges, dense_matrix, pattern, spd

BAR = pattern(6 * 4 * 9, bar_edges(5, 3, 8), np.arange(24))


def filled(row_start: NDArray, columns: NDArray, order: NDArray) -> NDArray[np.bool_]:
    """Pattern of L by elimination on a dense matrix, (nodes, nodes)."""
    nodes = len(order)
    graph = np.zeros((nodes, nodes), bool)
    graph[np.repeat(np.arange(nodes), np.diff(row_start)), columns] = True
    graph = graph[np.ix_(order, order)]
    for k in range(nodes):
        below = k + 1 + np.flatnonzero(graph[k + 1 :, k])
        graph[np.ix_(below, below)] = True
    return np.tril(graph)


def test_columns_and_parents_are_those_of_dense_elimination():
    tree = eliminate(*BAR, ordering.order_nodes(*BAR))
    fill = filled(*BAR, tree.order)
    for k in range(len(tree.order)):
        below = k + 1 + np.flatnonzero(fill[k + 1 :, k])
        assert np.array_equal(tree.rows_below(k), below)
        assert tree.count[k] == len(below) + 1
        assert tree.parent[k] == (below[0] if len(below) else -1)


@pytest.mark.parametrize("seed", range(12))
def test_native_columns_are_those_of_the_sets(seed):
    """Of random graphs, some of them in several pieces, in random orders; the rows of a column in any order."""
    rng = np.random.default_rng(seed)
    nodes = int(rng.integers(1, 60))
    graph = pattern(nodes, rng.integers(0, nodes, (int(rng.integers(0, 3 * nodes)), 2)))
    order = rng.permutation(nodes)
    found, wanted = native_columns(*graph, order), columns_of(*column_structures(*graph, order))
    assert found is not None
    for name in ("parent", "entries", "length"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name)), name
    for k in np.flatnonzero(wanted.length > 0):
        mine, theirs = (c.rows[c.first[k] : c.first[k] + c.length[k]] for c in (found, wanted))
        assert np.array_equal(np.sort(mine), np.sort(theirs))


def test_the_postorder_keeps_subtrees_together_and_the_fill():
    order = ordering.order_nodes(*BAR)
    tree = eliminate(*BAR, order)
    assert sorted(tree.order) == list(range(len(order)))
    assert tree.count.sum() == filled(*BAR, order).sum()
    descendants = np.ones(len(order), int)
    for node, parent in enumerate(tree.parent):
        if parent >= 0:
            descendants[parent] += descendants[node]
    for node, parent in enumerate(tree.parent):  # a subtree is node - descendants + 1 .. node
        assert parent == -1 or parent - descendants[parent] < node < parent


def test_postorder_puts_the_heaviest_child_next_to_its_parent():
    parent = np.array([4, 4, 4, -1, 3])
    assert postorder(parent, np.array([1, 9, 5, 1, 1])).tolist() == [0, 2, 1, 4, 3]


def test_panels_cover_the_columns_and_hold_few_zeros():
    tree = eliminate(*BAR, ordering.order_nodes(*BAR))
    panels = relaxed_supernodes(tree)
    assert [panel.first for panel in panels[1:]] == [panel.last + 1 for panel in panels[:-1]]
    assert (panels[0].first, panels[-1].last) == (0, len(tree.order) - 1)
    assert len(panels) < len(fundamental_supernodes(tree))
    exact = 9 * tree.count - 3
    for panel in panels:
        assert panel.zeros == panel.size - exact[panel.first : panel.last + 1].sum()
        assert panel.zeros == 0 or any(panel.width <= w and panel.zeros < z * panel.size for w, z in ZEROS_BY_WIDTH)


def test_every_entry_of_the_exact_factor_is_in_the_pattern():
    analysis = Analysis(*BAR)
    stored = supernodal.lower(analysis.pattern, np.ones(analysis.pattern.nonzeros)) != 0
    exact = filled(*BAR, analysis.pattern.permutation[::3] // 3)
    assert np.all(stored >= np.tril(np.kron(exact, np.ones((3, 3), bool))))
    assert np.count_nonzero(stored) == analysis.pattern.nonzeros


def test_the_symbolic_phase_is_deterministic():
    first, second = Analysis(*BAR).pattern, Analysis(*(array.copy() for array in BAR)).pattern
    assert first.id == second.id
    assert np.array_equal(first.rows, second.rows)


def test_the_degrees_of_freedom_of_a_node_stay_together():
    permutation = Analysis(*BAR).pattern.permutation
    assert np.array_equal(permutation, (permutation[::3, None] + np.arange(3)).ravel())


@pytest.mark.parametrize("missing", [["pymetis"], ["pymetis", "sksparse", "sksparse.cholmod"]])
def test_without_metis_the_order_still_reduces_fill(missing, monkeypatch):
    for module in missing:
        monkeypatch.setitem(sys.modules, module, None)
    order = ordering.order_nodes(*BAR)
    assert sorted(order) == list(range(len(BAR[0]) - 1))
    natural = np.arange(len(order))
    assert eliminate(*BAR, order).count.sum() < 0.8 * eliminate(*BAR, natural).count.sum()
    values = spd(*BAR)
    analysis = Analysis(*BAR, "supernodal")
    lower = supernodal.lower(analysis.pattern, analysis.factorize(values, np.float64))
    order = analysis.pattern.permutation
    np.testing.assert_allclose(lower @ lower.T, dense_matrix(*BAR, values)[np.ix_(order, order)], atol=1e-12)


def test_a_library_factor_outside_the_pattern_is_an_error():
    analysis = Analysis(*pattern(3, np.array([[0, 1]])), "supernodal")
    dense = np.tril(np.ones((9, 9)))
    out = np.empty(analysis.pattern.nonzeros)
    with pytest.raises(RuntimeError, match="does not fit"):
        Packer(analysis.pattern).pack(csc_matrix(dense), out)


@pytest.mark.parametrize(
    ("row_start", "columns", "message"),
    [
        ([0], [], "must ascend from 0"),
        ([0, 1, 3], [0, 1], "must ascend from 0 to the number of blocks, 2"),
        ([0, 2, 1, 2], [0, 1], "must ascend from 0"),
        ([1, 2], [0, 0], "must ascend from 0"),
        ([0, 2, 3], [0, 2, 1], "between 0 and 1"),
        ([0, 2, 3], [0, -1, 1], "between 0 and 1"),
        ([0, 2, 4], [1, 0, 0, 1], "columns of a row must ascend"),
        ([0, 2, 4], [0, 0, 0, 1], "columns of a row must ascend"),
        ([0, 2, 3], [0, 1, 1], "no mirror image"),
        ([0, 1, 2], [1, 0], "needs its diagonal block"),
        ([0, 0], [], "needs its diagonal block"),
        ([[0, 1]], [0], "one-dimensional"),
        ([0.0, 1.0], [0], "one-dimensional arrays of integers"),
    ],
)
def test_a_pattern_that_is_none_is_named(row_start, columns, message):
    with pytest.raises(ValueError, match=message):
        Analysis(np.array(row_start), np.array(columns, np.int32))
