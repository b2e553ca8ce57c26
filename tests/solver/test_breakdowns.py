# SPDX-License-Identifier: MIT
"""Solves that cannot go right, each with its name; and factors that are no good, which cost iterations only."""

import numpy as np
import pytest

from sim_server.backends.kinds import Kind
from tests.scenes import factor_of
from tests.solver.solves import STATUSES, bent, solve, true_residual


def status(record) -> str:
    return STATUSES[record["status"]]


def diagonal_block(sim, node: int) -> int:
    """Place of a node's diagonal block among the values."""
    start = sim.system.row_start[node]
    return int(start + np.flatnonzero(sim.system.columns[start : sim.system.row_start[node + 1]] == node)[0])


def test_too_few_iterations():
    sim = bent(preconditioner="block_jacobi")
    y, record = solve(sim, max_iterations=5)
    assert status(record) == "max_iterations"
    assert record["iterations"] == 5
    assert record["residual"] == pytest.approx(true_residual(sim, y), rel=1e-9)
    assert np.isfinite(y).all()


def test_out_of_time():
    sim = bent()
    y, record = solve(sim, kind=Kind.NONE, budget=1e-9)
    assert status(record) == "budget"
    assert record["iterations"] < 5
    assert record["residual"] == pytest.approx(true_residual(sim, y), rel=1e-9)
    assert status(solve(sim, kind=Kind.NONE, budget=60.0)[1]) == "converged"


@pytest.mark.parametrize("kind", [Kind.NONE, Kind.JACOBI, Kind.BLOCK_JACOBI])
def test_an_indefinite_matrix_is_named(kind):
    """The blocks off the diagonal are multiplied by 5: z'r > 0 still, p'Ap < 0 for some p."""
    sim = bent()
    diagonal = [diagonal_block(sim, i) for i in range(sim.world.nodes)]
    off = np.setdiff1d(np.arange(len(sim.system.values)), diagonal)
    sim.system.values[off] *= 5
    y, record = solve(sim, kind=kind)
    assert status(record) == "breakdown_matrix"
    assert np.isfinite(y).all()
    assert record["residual"] == pytest.approx(true_residual(sim, y), rel=1e-9)


def test_an_indefinite_matrix_is_named_with_a_factor_too():
    sim = bent()
    sim.engine.post_factor(0, *factor_of(sim), step=0)
    diagonal = [diagonal_block(sim, i) for i in range(sim.world.nodes)]
    off = np.setdiff1d(np.arange(len(sim.system.values)), diagonal)
    sim.system.values[off] *= 5
    assert status(solve(sim, kind=Kind.CHOLESKY)[1]) == "breakdown_matrix"


@pytest.mark.parametrize("kind", [Kind.JACOBI, Kind.BLOCK_JACOBI])
def test_a_negative_diagonal_block_is_named(kind):
    """-1000 times a block: every z'r is negative as soon as that node has any residual."""
    sim = bent()
    node = int(np.flatnonzero(sim.world.free)[-1])
    sim.system.values[diagonal_block(sim, node)] *= -1e-6
    y, record = solve(sim, kind=kind)
    assert status(record) == "breakdown_preconditioner"
    assert np.isfinite(y).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_right_hand_side_that_is_not_finite(bad):
    sim = bent()
    sim.system.b_material[17, 1] = bad
    y, record = solve(sim, kind=Kind.BLOCK_JACOBI)
    assert status(record) == "not_finite"
    assert record["bad_node"] == 17
    assert not np.isfinite(record["residual"])
    assert np.isnan(y).all()  # the sign that the body is to go back


def test_a_matrix_that_is_not_finite_does_not_move_anything():
    sim = bent()
    sim.system.values[:] = np.nan
    for kind in Kind:
        y, record = solve(sim, kind=kind)
        assert status(record) in ("breakdown_matrix", "breakdown_preconditioner")
        assert not y.any()


def test_bad_nodes_are_numbered_within_their_body():
    from tests.scenes import bar, simulation

    sim = simulation(bar(name="a", young=1e4), bar(name="b", young=1e4))
    sim.engine.assemble()
    first = sim.world.bodies[1].first
    sim.system.b_material[first + 4, 2] = np.nan
    sim.engine.solve()
    records = sim.engine.records()
    assert [STATUSES[s] for s in records["status"]] == ["converged", "not_finite"]
    assert records["bad_node"].tolist() == [-1, 4]


def poison(values: np.ndarray, how: str) -> np.ndarray:
    random = np.random.default_rng(5)
    bad = values.copy()
    if how == "nan":
        bad[len(bad) // 2] = np.nan
    elif how == "infinite":
        bad[len(bad) // 3] = np.inf
    elif how == "zero":
        bad[:] = 0
    elif how == "zero pivot":
        bad[-1] = 0
    elif how == "huge":
        bad *= np.finfo(bad.dtype).max / np.abs(bad).max()
    elif how == "tiny":
        bad *= np.finfo(bad.dtype).tiny / np.abs(bad).max()
    elif how == "random":
        bad = random.normal(size=len(bad)).astype(bad.dtype)
    elif how == "one pivot tiny":
        bad[-1] *= bad.dtype.type(1e-12)
    elif how == "some flipped":
        flip = random.random(len(bad)) < 0.02
        bad[flip] *= -1000
    elif how == "shuffled":
        random.shuffle(bad)
    elif how == "negative":
        bad = -bad
    return bad


POISONS = [
    "nan",
    "infinite",
    "zero",
    "zero pivot",
    "huge",
    "tiny",
    "random",
    "one pivot tiny",
    "some flipped",
    "shuffled",
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("how", POISONS)
def test_a_poisoned_factor_costs_iterations_and_never_the_answer(how, dtype):
    sim = bent(tolerance=1e-6, max_iterations=500)
    pattern, values = factor_of(sim, dtype=dtype)
    good, block_jacobi = solve(sim, kind=Kind.BLOCK_JACOBI)
    sim.engine.post_factor(0, pattern, poison(values, how), 0)
    y, record = solve(sim, kind=Kind.CHOLESKY)
    assert status(record) == "converged"
    assert true_residual(sim, y) <= 1e-6
    assert record["iterations"] <= 250 + 2 * block_jacobi["iterations"]  # at worst half of those allowed are lost
    if how in ("nan", "infinite", "zero", "zero pivot", "random", "shuffled", "some flipped"):
        assert record["fallbacks"] == 1
        assert record["kind"] == Kind.BLOCK_JACOBI
        assert record["factor_step"] == 0  # the factor that was tried
    assert np.linalg.norm(y - good) < 1e-3 * np.linalg.norm(good)


def test_the_sign_of_a_factor_does_not_matter():
    """(-L)(-L)^T is L L^T: what is applied is positive definite whatever stands in L."""
    sim = bent()
    pattern, values = factor_of(sim)
    sim.engine.post_factor(0, pattern, poison(values, "negative"), 0)
    _, record = solve(sim, kind=Kind.CHOLESKY)
    assert (record["iterations"], record["fallbacks"]) == (1, 0)
