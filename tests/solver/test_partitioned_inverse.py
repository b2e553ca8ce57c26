# SPDX-License-Identifier: MIT
"""gpu/inverse/plan.py and what is made for it: applied in NumPy as the GPU applies it, against the matrix itself."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from protocol.factor import FactorPattern
from sim_server.backends.gpu.inverse.expansion_batches import workspace_layout
from sim_server.backends.gpu.inverse.partition import tree_of
from sim_server.backends.gpu.inverse.plan import FORM, GATHER, READ, WRITE, Plan, lay_out, plan
from sim_server.simulation import Simulation
from tests.hard_cases.case import BAR, GRAVITY
from tests.reference.partitioned import Application, by_tasks, stored
from tests.reference.supernodal import columns
from tests.scenes import bar, factor_of, simulation
from tests.support.digits import iterations_by_digits
from tests.worker.block_matrices import bar_edges, dense_matrix, pattern, spd

GRAPHS = {
    "bar": pattern(216, bar_edges(5, 5, 5)),
    "long bar with a fixed end": pattern(9 * 5 * 6, bar_edges(8, 4, 5), np.arange(9)),
    "two bars": pattern(120, np.concatenate([bar_edges(3, 2, 4), 60 + bar_edges(3, 2, 4)])),
    "one node": pattern(1, np.empty((0, 2), int)),
    "all fixed": pattern(25, np.array([[0, 1], [1, 4]]), np.arange(25)),
    "chain": pattern(60, np.array([[i, i + 1] for i in range(59)])),
    "star": pattern(30, np.array([[11, i] for i in range(30) if i != 11])),
    "complete": pattern(24, np.array([[i, j] for i in range(24) for j in range(i)])),
}
graphs = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS.keys())
BLOCKS = (1, 3, 16, 132)


def system(graph: tuple[NDArray, NDArray], seed: int = 0) -> SimpleNamespace:
    """Pattern and values of L, a right-hand side and the solution."""
    analysis, values = Analysis(*graph), spd(*graph, seed=seed)
    matrix = dense_matrix(*graph, values)
    r = np.random.default_rng(seed).normal(size=len(matrix))
    factor = analysis.factorize(values, np.float64)
    return SimpleNamespace(pattern=analysis.pattern, factor=factor, r=r, z=np.linalg.solve(matrix, r))


def plans(pattern: FactorPattern, planes: int = 1) -> list[Plan]:
    """With 1 to 5 groups, as far as the tree has so many sizes, and the one chosen; for several numbers of blocks."""
    tree = tree_of(pattern)
    sizes = np.unique(tree.size).tolist()
    found = []
    for groups in range(1, min(5, len(sizes)) + 1):
        thresholds = tuple(sizes[k * len(sizes) // groups] for k in range(1, groups))
        found += [lay_out(tree, thresholds, blocks, planes) for blocks in BLOCKS]
    return found + [plan(pattern, blocks, planes=planes) for blocks in BLOCKS]


def error(s: SimpleNamespace, p: Plan, dtype: type) -> float:
    z = Application(p, *stored(s.pattern, s.factor, p, dtype))(s.r)
    return float(np.linalg.norm(z - s.z) / np.linalg.norm(s.z))


@graphs
def test_it_solves(graph):
    s = system(graph)
    cases = plans(s.pattern)
    assert len(cases) >= 2 * len(BLOCKS)
    for p in cases:
        assert error(s, p, np.float64) < 1e-12


@graphs
def test_float16_errs_by_its_rounding_and_two_planes_by_that_of_float32(graph):
    """Entries lose half a unit of float16's 11 binary digits, 2^-12; with the remainder 2^-23. Sums of them on these
    diagonally dominant matrices lose at most 8 times as much."""
    s = system(graph, seed=1)
    for planes, bound in ((1, 2.0**-9), (2, 2.0**-20)):
        for p in plans(s.pattern, planes)[:: len(BLOCKS) - 1]:
            assert error(s, p, np.float16) < bound


def test_it_solves_the_system_of_a_step():
    sim = simulation(bar((8, 4, 4), (2, 1, 1), young=1e6, fixed="X < 0.01"))
    sim.engine.assemble()
    pattern_, factor = factor_of(sim)
    r = np.random.default_rng(0).normal(size=3 * sim.world.nodes)
    z = np.linalg.solve(sim.matrix().toarray(), r)
    s = SimpleNamespace(pattern=pattern_, factor=factor, r=r, z=z)
    for groups, blocks in itertools.product((1, 2, 3), (1, 16)):
        p = plan(pattern_, blocks, groups)
        assert p.groups == groups and p.phases == 2 * groups - 1
        assert error(s, p, np.float64) < 1e-12
        assert error(s, p, np.float16) < 5e-3  # its condition number is about 100


HARD = {
    "stiff and soft side by side": 'young=[{ where = "X < 0.5", young = 1e10 }, { young = 1e4 }]',
    "nearly incompressible": "poisson=0.4999",
}


@pytest.mark.parametrize("law", HARD.values(), ids=HARD.keys())
def test_what_11_binary_digits_do_not_bear_22_do(law):
    """Solves of a step by CG with the factor of its own matrix, stored as a GPU does."""
    mesh = "object.bar.mesh={ bar = [2, 2, 8], size = [1, 1, 4] }"
    sim = Simulation.load(BAR, [GRAVITY, mesh, f"object.bar.effects.corotational.{law}"])
    iterations, _, _ = iterations_by_digits(sim, 20, 200)
    assert iterations[1] <= 3 and iterations[0] > 3 * iterations[1], iterations


def test_the_operator_is_symmetric_and_positive_also_in_float16():
    """W~ is rounded once and used twice, so symmetry is lost only to the rounding of float64 sums."""
    s = system(GRAPHS["long bar with a fixed end"])
    random = np.random.default_rng(1)
    for p in (plan(s.pattern, 3, groups) for groups in (1, 2, 3)):
        apply = Application(p, *stored(s.pattern, s.factor, p, np.float16))
        for _ in range(3):
            a, b = random.normal(size=(2, len(s.r)))
            assert abs(a @ apply(b) - b @ apply(a)) < 1e-12 * np.sqrt((a @ apply(a)) * (b @ apply(b)))
            assert a @ apply(a) > 0


def test_what_is_stored_does_not_depend_on_units_or_stiffness_ratios():
    """C A C with any diagonal C has the factor C L: the scale takes it up, so float16 loses nothing to it."""
    s = system(GRAPHS["long bar with a fixed end"])
    c = np.exp(3 * np.random.default_rng(2).normal(size=len(s.r)))  # entries of the matrix over ten decades
    scaled = np.concatenate([v * c[rows] for rows, v in columns(s.pattern, s.factor)])
    for groups in (1, 2, 3):
        p = plan(s.pattern, 3, groups)
        (chunks, scale), (other, lengths) = stored(s.pattern, s.factor, p), stored(s.pattern, scaled, p)
        assert np.abs(other - chunks).max() < 1e-9 and np.abs(chunks).max() < 2
        own = p.column >= 0
        np.testing.assert_allclose(lengths[:-1][own] * c[p.column[own]], scale[:-1][own], rtol=1e-9)


@graphs
def test_every_position_is_written_once(graph):
    s = system(graph)
    for p in plans(s.pattern):
        apply = Application(p, *stored(s.pattern, s.factor, p))
        apply(s.r)
        real = p.column >= 0
        backward = np.sum([w[: p.size] for w in apply.writes[p.groups - 1 :]], axis=0)
        assert (backward[real] == 1).all() and backward.max() == 1
        forward = np.sum([np.zeros(p.contributions, int), *apply.writes[: p.groups - 1]], axis=0)
        assert (forward == 1).all()
        assert np.array_equal(np.sort(p.slots), np.unique(p.slots)) and len(p.slots) == p.parts.b.sum()


@graphs
def test_blocks_have_what_their_tiles_read_and_their_chunks_in_one_piece(graph):
    s = system(graph)
    for p in plans(s.pattern):
        taken = np.zeros(p.chunks, int)
        for phase, block in itertools.product(range(p.phases), range(p.blocks)):
            at = phase * p.blocks + block
            segments = p.segments[p.segment_start[at] : p.segment_start[at + 1]]
            assert np.array_equal(segments[:, 3], np.cumsum(segments[:, 2]) - segments[:, 2]), "one after another"
            assert (segments[:, 2:] % 32 == 0).all() and segments[:, 2].sum() <= p.x_area
            for chunk, x, count, out in p.tiles[p.tile_start[at] : p.tile_start[at + 1]]:
                taken[chunk : chunk + count] += 1
                assert p.chunk_start[block] <= chunk and chunk + count <= p.chunk_start[block + 1]
                assert x in segments[:, 3] and x + 32 * count <= segments[:, 2].sum() and out % 8 == 0
        assert (taken == 1).all() and p.chunk_start[-1] == p.chunks and p.bytes == 512 * p.chunks


@graphs
def test_what_is_read_later_is_stored_by_exactly_one_block(graph):
    s = system(graph)
    for p in plans(s.pattern):
        for phase in range(p.phases):
            low, high = p.segment_start[phase * p.blocks], p.segment_start[(phase + 1) * p.blocks]
            kind, start = p.segments[low:high, 0], p.segments[low:high, 1]
            if phase < p.groups - 1:
                writers = start[kind == FORM | WRITE]
                assert np.array_equal(np.sort(writers), np.unique(start)) and not (kind & ~WRITE).any()
            elif phase == p.groups - 1:
                assert (kind == FORM).all()
            else:
                assert np.isin(kind, (READ, GATHER)).all()


def test_all_blocks_get_about_the_same():
    """No block reads more than its share and one part of a block's work."""
    s = system(GRAPHS["bar"])
    for blocks in (1, 3, 16):
        p = plan(s.pattern, blocks, 1)
        chunks = np.diff(p.chunk_start)
        assert chunks.max() - chunks.mean() <= 0.2 * chunks.mean() + p.tiles[:, 2].max()


def test_fixed_nodes_share_parts():
    s = system(GRAPHS["all fixed"])
    p = plan(s.pattern, 1)
    assert p.groups == 1 and p.parts.v.tolist() == [30, 30, 15] and p.size == 96


def test_more_groups_than_the_tree_has_are_as_many_as_it_has():
    assert plan(system(GRAPHS["one node"]).pattern, 3, 4).groups == 1
    s = system(GRAPHS["long bar with a fixed end"])
    assert plan(s.pattern, 3, 3).groups == 3 and plan(s.pattern, 3, 2).groups == 2


def test_plans_are_kept():
    s = system(GRAPHS["chain"])
    assert plan(s.pattern, 3) is plan(s.pattern, 3) is not plan(s.pattern, 4)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 30), st.data())
def test_it_solves_on_any_graph(nodes, data):
    ends = st.tuples(st.integers(0, nodes - 1), st.integers(0, nodes - 1)).filter(lambda e: e[0] != e[1])
    edges = data.draw(st.lists(ends, max_size=3 * nodes)) if nodes > 1 else []
    fixed = np.array(data.draw(st.lists(st.integers(0, nodes - 1), max_size=3)), int)
    s = system(pattern(nodes, np.array(edges).reshape(-1, 2), fixed))
    thresholds = tuple(sorted(data.draw(st.sets(st.integers(3, 90), max_size=4))))
    p = lay_out(tree_of(s.pattern), thresholds, data.draw(st.sampled_from((1, 2, 7, 132))))
    assert error(s, p, np.float64) < 1e-11
    chunks, scale = stored(s.pattern, s.factor, p)
    made, lengths = by_tasks(workspace_layout(s.pattern, p, data.draw(st.sampled_from((1000, 100000)))), s.factor, p)
    assert np.abs(made - chunks).max() < 1e-12 and np.abs(lengths - scale).max() < 1e-12


def test_the_tasks_of_the_kernels_make_the_matrices_of_the_plan():
    """Several tiles of 64 per part, parts of several tiles, one batch and many."""
    s = system(GRAPHS["long bar with a fixed end"])
    for groups, room in itertools.product((1, 2, 3), (1000, 1 << 28)):
        p = plan(s.pattern, 3, groups)
        exact, made = stored(s.pattern, s.factor, p), by_tasks(workspace_layout(s.pattern, p, room), s.factor, p)
        assert np.abs(made[0] - exact[0]).max() < 1e-12 and np.abs(made[1] - exact[1]).max() < 1e-12
        assert (room > 1000) == (len(workspace_layout(s.pattern, p, room).batches) == 1)


def test_a_pattern_without_whole_nodes_is_refused():
    whole = Analysis(*GRAPHS["chain"]).pattern
    permutation = whole.permutation.copy()
    permutation[[0, 3]] = permutation[[3, 0]]
    mixed = FactorPattern.build(permutation, whole.super_start, whole.row_start, whole.rows)
    with pytest.raises(ValueError, match="keep the 3 degrees of freedom of a node together"):
        plan(mixed, 4)
    single = FactorPattern.build(np.arange(2), [0, 1, 2], [0, 2, 3], [0, 1, 1])
    with pytest.raises(ValueError, match="keep the 3 degrees of freedom of a node together"):
        plan(single, 4)


def test_rows_that_no_cholesky_factor_has_are_refused():
    """Node 0 couples 1 and 2, so 1 must have 2 among its rows."""
    rows = np.concatenate([np.arange(9), np.arange(3, 6), np.arange(6, 9)])
    open_ = FactorPattern.build(np.arange(9), [0, 3, 6, 9], [0, 9, 12, 15], rows)
    with pytest.raises(ValueError, match="missing in its parent"):
        plan(open_, 4)
