# SPDX-License-Identifier: MIT
"""Native planning of the partitioned inverse against the same in NumPy and plain Python."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu.inverse import load_balance, partition, tree_cuts
from sim_server.backends.gpu.inverse import plan as module
from sim_server.backends.gpu.inverse.load_balance import PhaseWork
from sim_server.backends.gpu.inverse.partition import Tree
from sim_server.backends.gpu.inverse.plan import lay_out, plan
from tests.reference import tree_cuts as reference
from tests.solver.test_partitioned_inverse import graphs

SHARED = 200_000


def random_tree(rng: np.random.Generator, supernodes: int) -> Tree:
    """A forest whose supernodes have random widths and, but at roots, rows below."""
    parent = np.array(
        [rng.integers(s + 1, min(supernodes, s + 9)) if s + 1 < supernodes else -1 for s in range(supernodes)]
    )
    parent[rng.random(supernodes) < 0.1] = -1
    width = 3 * rng.integers(1, 30, supernodes)
    height = width + np.where(parent >= 0, 3 * rng.integers(1, 60, supernodes), 0)
    return Tree(None, parent, width, height)  # type: ignore[arg-type]  # the pattern is not used


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), supernodes=st.integers(1, 50), blocks=st.sampled_from([1, 2, 7, 124]))
def test_partitions_thresholds_and_balance_are_those_of_the_reference(seed, supernodes, blocks):
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, supernodes)
    cuts = tuple(sorted(set(rng.integers(3, 2000, rng.integers(0, 4)).tolist())))
    for mine, other in zip(partition.partition(tree, cuts), reference.partition(tree, cuts), strict=True):
        assert np.array_equal(mine, other)
    planes, groups = int(rng.integers(1, 3)), int(rng.integers(1, 5)) if rng.random() < 0.3 else None
    chosen = tree_cuts.choose_thresholds(tree, blocks, groups, planes, SHARED)
    assert chosen == reference.choose_thresholds(tree, blocks, groups, planes, SHARED)
    cut = reference.partition(tree, cuts)
    time = tree_cuts.predict(tree, cuts, blocks, planes, SHARED)
    assert time == pytest.approx(reference.predict(cut, blocks, planes, SHARED), rel=1e-13)
    works = zip(tree_cuts.phase_work(cut, planes), reference.phase_work(cut, planes), strict=True)
    for (mine, work), (other, wanted) in works:
        assert np.array_equal(mine, other)
        assert all(np.array_equal(a, b) for a, b in zip(work, wanted, strict=True))
        if len(mine):
            pieces = zip(load_balance.balance(work, blocks), reference.balance(wanted, blocks), strict=True)
            assert all(np.array_equal(a, b) for a, b in pieces)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), matrices=st.integers(1, 60), blocks=st.integers(1, 40))
def test_the_balance_is_that_of_the_reference(seed, matrices, blocks):
    rng = np.random.default_rng(seed)
    columns = 32 * rng.integers(1, 200, matrices)
    work = PhaseWork(rng.integers(1, 300, matrices), columns * 16 / 33.0, 250 + 0.4 * columns)
    pieces = zip(load_balance.balance(work, blocks), reference.balance(work, blocks), strict=True)
    assert all(np.array_equal(a, b) for a, b in pieces)


@graphs
def test_plans_are_those_of_the_reference(graph, monkeypatch):
    """Every array of a plan, with all that native code computes done by the reference."""
    pattern = Analysis(*graph).pattern
    found = plan(pattern, 12)
    tree = partition.tree_of(pattern)
    thresholds = reference.choose_thresholds(tree, 12, None, 1, tree_cuts.SHARED_MEMORY)
    for name in ("partition", "phase_work", "balance"):
        monkeypatch.setattr(module, name, getattr(reference, name))
    for name, value in vars(lay_out(tree, thresholds, 12)).items():
        mine = getattr(found, name)
        same = all(map(np.array_equal, mine, value)) if name == "parts" else np.array_equal(mine, value)
        assert same, name


def test_tiles_of_large_matrices_have_a_constant_time_beside_that_of_their_bytes():
    cut = reference.partition(random_tree(np.random.default_rng(3), 30), (200,))
    for planes in (20_000, 40_000):  # as if each matrix was so many times as large
        works = zip(tree_cuts.phase_work(cut, planes), reference.phase_work(cut, planes), strict=True)
        assert all(np.array_equal(mine.tile, wanted.tile) for (_, mine), (_, wanted) in works)
    twice = zip(tree_cuts.phase_work(cut, 20_000), tree_cuts.phase_work(cut, 40_000), strict=True)
    for (_, one), (_, two) in twice:
        np.testing.assert_allclose(2 * one.tile - two.tile, reference.TILE, rtol=1e-6)
