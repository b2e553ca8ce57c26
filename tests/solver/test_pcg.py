# SPDX-License-Identifier: MIT
"""backends/cpu/native/pcg.h through the loop against the textbook's conjugate gradients, iterate by iterate."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve

from sim_server.backends.kinds import Kind
from tests.reference.pcg import block_jacobi, jacobi, pcg
from tests.scenes import factor_of
from tests.solver.solves import applied, bent, solve, stops, system, true_residual

KINDS = ["none", "jacobi", "block_jacobi", "fresh", "stale", "stale float32"]
kinds = pytest.mark.parametrize("name", KINDS)


def prepared(name: str, **solver):
    """(simulation, Kind, r -> P^-1 r). A stale factor is from another state of the bar, in its own material frame."""
    sim = bent(**solver)
    if name in ("none", "jacobi", "block_jacobi"):
        operator = {"none": lambda r: r, "jacobi": jacobi(sim.matrix()), "block_jacobi": block_jacobi(sim.matrix())}
        return sim, Kind[name.upper()], operator[name]
    dtype = np.float32 if name.endswith("float32") else np.float64
    pattern, values = factor_of(sim if name == "fresh" else bent(seed=9), dtype=dtype)
    sim.engine.post_factor(0, pattern, values, 0)
    return sim, Kind.CHOLESKY, applied(pattern, values)


@kinds
def test_iterations_are_those_of_the_textbook(name):
    sim, kind, preconditioner = prepared(name)
    A, b = system(sim)
    expected = pcg(A, b, preconditioner, 1e-9, 5000)
    y, record = solve(sim, kind=kind)
    assert record["status"] == 0
    assert record["kind"] == kind
    taken = int(record["iterations"])
    assert abs(taken - (len(expected) - 1)) <= (1 if taken > 50 else 0)  # rounding adds up
    assert np.linalg.norm(y - expected[-1]) < 1e-8 * np.linalg.norm(y)
    assert {"none": 80, "jacobi": 50, "block_jacobi": 50, "fresh": 1}.get(name, 5) <= record["iterations"]


@pytest.mark.parametrize("name", [n for n in KINDS if n != "fresh"])
def test_iterates_are_those_of_the_textbook(name):
    """Ended after k iterations the loop holds x_k, for all k at which the residual is the smallest so far."""
    sim, kind, preconditioner = prepared(name)
    A, b = system(sim)
    expected = pcg(A, b, preconditioner, 1e-9, 5000)
    checked = 0
    for k, tolerance in stops(A, b, expected[:25]):
        y, record = solve(sim, kind=kind, tolerance=tolerance)
        assert (record["iterations"], record["status"]) == (k, 0)
        bound = 1e-5 if name == "stale float32" else 1e-9 if k <= 8 else 1e-6  # the iteration amplifies rounding
        assert np.linalg.norm(y - expected[k]) < bound * np.linalg.norm(expected[-1])
        checked += 1
    assert checked > 5


@pytest.mark.parametrize("name", ["none", "jacobi", "block_jacobi"])
def test_iterations_allowed_are_not_exceeded(name):
    sim, kind, preconditioner = prepared(name)
    A, b = system(sim)
    expected = pcg(A, b, preconditioner, 1e-9, 5000)
    for k in (1, 2, 10, 20):
        y, record = solve(sim, kind=kind, max_iterations=k)
        assert (record["iterations"], record["status"]) == (k, 1)
        assert np.linalg.norm(y - expected[k]) < 1e-9 * np.linalg.norm(expected[-1])


@kinds
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
def test_converged_means_the_true_residual(name, tolerance):
    sim, kind, _ = prepared(name, tolerance=tolerance)
    y, record = solve(sim, kind=kind)
    assert record["status"] == 0
    assert record["residual"] <= tolerance
    assert true_residual(sim, y) == pytest.approx(record["residual"], rel=1e-3)
    exact = spsolve(*system(sim))
    assert np.linalg.norm(y - exact) < 1e3 * tolerance * np.linalg.norm(exact)


def test_a_tolerance_below_rounding_ends_without_a_lie():
    sim = bent(tolerance=1e-17)
    y, record = solve(sim, kind=Kind.BLOCK_JACOBI)
    assert record["status"] == 1
    assert record["iterations"] < 1000
    assert 1e-17 < record["residual"] < 1e-12
    assert true_residual(sim, y) == pytest.approx(record["residual"], rel=0.5)


def test_a_fresh_factor_needs_one_iteration_and_one_in_single_precision_two():
    for dtype, most in ((np.float64, 1), (np.float32, 3)):
        sim = bent()
        sim.engine.post_factor(0, *factor_of(sim, dtype=dtype), step=0)
        assert 1 <= solve(sim, kind=Kind.CHOLESKY)[1]["iterations"] <= most


@kinds
def test_warm_start_has_the_same_answer(name):
    sim, kind, _ = prepared(name)
    cold, record = solve(sim, kind=kind, warm_start=0)
    near = cold + 1e-4 * np.linalg.norm(cold) / np.sqrt(len(cold)) * np.random.default_rng(1).normal(size=len(cold))
    near[np.repeat(sim.world.free, 3) == 0] = 0
    warm, second = solve(sim, start=near, kind=kind, warm_start=1)
    assert second["status"] == 0
    assert second["iterations"] <= record["iterations"]
    assert np.linalg.norm(warm - cold) < 1e-6 * np.linalg.norm(cold)
    again, third = solve(sim, start=cold, kind=kind, warm_start=1)
    assert third["iterations"] == 0
    assert np.array_equal(again, cold)


@pytest.mark.parametrize("start", [1e9, np.nan, np.inf])
def test_a_start_worse_than_zero_is_thrown_away(start):
    sim = bent()
    cold, record = solve(sim, kind=Kind.BLOCK_JACOBI)
    other, second = solve(sim, start=np.full(len(cold), start), kind=Kind.BLOCK_JACOBI)
    assert np.array_equal(other, cold)
    assert second["iterations"] == record["iterations"]


def test_nothing_to_do():
    sim = bent()
    sim.system.b_material[:] = 0
    y, record = solve(sim, start=np.ones(3 * sim.world.nodes), kind=Kind.BLOCK_JACOBI)
    assert not y.any()
    assert (record["status"], record["iterations"], record["residual"]) == (0, 0, 0)


@pytest.mark.parametrize("scale", [1e-140, 1e-30, 1e30, 1e140])
def test_the_size_of_the_right_hand_side_does_not_matter(scale):
    """Also to a factor in single precision: r is brought to length one before it is applied."""
    sim, kind, _ = prepared("stale float32", tolerance=1e-6)
    y, record = solve(sim, kind=kind)
    sim.system.b_material *= scale
    scaled, second = solve(sim, kind=kind)
    assert second["status"] == 0
    assert second["fallbacks"] == 0
    assert second["iterations"] == record["iterations"]
    assert np.linalg.norm(scaled / scale - y) < 1e-5 * np.linalg.norm(y)


def test_fixed_nodes_stay_exactly_zero():
    for name in KINDS:
        sim, kind, _ = prepared(name)
        y, _ = solve(sim, kind=kind)
        assert not y[np.repeat(sim.world.free, 3) == 0].any()


@pytest.mark.parametrize("probe", [1, 3, 7])
def test_a_probe_begins_with_one_and_ends_with_the_other(probe):
    """Block Jacobi for `probe` iterations, then the factor, starting again from where the first got to; and back."""
    sim, _, factor = prepared("stale")
    A, b = system(sim)
    y, record = solve(sim, kind=Kind.BLOCK_JACOBI, probe=probe)
    half_way = pcg(A, b, block_jacobi(A), 1e-9, probe)[-1]
    expected = pcg(A, b, factor, 1e-9, 5000, x=half_way)
    assert record["status"] == 0
    assert record["asked"] == Kind.BLOCK_JACOBI
    assert record["kind"] == Kind.CHOLESKY
    assert abs(int(record["iterations"]) - (probe + len(expected) - 1)) <= 1
    assert np.linalg.norm(y - expected[-1]) < 1e-7 * np.linalg.norm(y)
    y, record = solve(sim, kind=Kind.CHOLESKY, probe=probe)
    assert record["status"] == 0
    assert record["kind"] == Kind.BLOCK_JACOBI
    assert record["iterations"] > probe
    assert true_residual(sim, y) <= 1e-9


def test_a_probe_that_converges_early_keeps_its_kind_and_one_without_factor_changes_nothing():
    sim, _, _ = prepared("stale")
    _, record = solve(sim, kind=Kind.CHOLESKY, probe=400)
    assert record["kind"] == Kind.CHOLESKY
    plain = bent()
    _, record = solve(plain, kind=Kind.BLOCK_JACOBI, probe=3)
    assert record["kind"] == Kind.BLOCK_JACOBI
    assert record["iterations"] == solve(plain, kind=Kind.BLOCK_JACOBI, probe=0)[1]["iterations"]


def test_cholesky_without_a_factor_is_block_jacobi():
    sim = bent()
    y, record = solve(sim, kind=Kind.CHOLESKY)
    assert (record["kind"], record["asked"], record["factor_step"]) == (Kind.BLOCK_JACOBI, Kind.CHOLESKY, -1)
    assert np.array_equal(y, solve(sim, kind=Kind.BLOCK_JACOBI)[0])
