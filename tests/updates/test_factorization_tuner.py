# SPDX-License-Identifier: MIT
"""Which factor "auto" asks for, as a state machine: costs of solves go in, the method of the next job comes out."""

import itertools

import pytest

from protocol.method import Method
from sim_server.backends.kinds import Kind
from sim_server.updates.autotune.factorization import (
    FIRST_SOLVES,
    MAX_FAILURES,
    MAX_SOLVES,
    MIN_SOLVES,
    SETTLE,
    FactorizationTuner,
)
from sim_server.updates.autotune.preconditioner import PreconditionerTuner
from sim_server.updates.autotune.tuner import MAX_TRIAL_INTERVAL, TRIAL_INTERVAL

IC, EXACT = Method("incomplete_cholesky", drop_tolerance=0.003, fill=10), Method()


class Bench:
    """A worker that makes a factor each `life` solves of whatever is asked for; costs: of a solve by method."""

    def __init__(self, incomplete: float, exact: float, life: int = 4):
        self.costs, self.life = {IC: incomplete, EXACT: exact}, life
        self.tuner = FactorizationTuner([IC, EXACT])
        self.step, self.made, self.used = 0, 0, self.tuner.method

    def run(self, solves: int) -> list[Method]:
        """Methods of the factors that they used."""
        found = []
        for _ in range(solves):
            if self.step % self.life == 0:
                self.made, self.used = self.step, self.tuner.method
                self.tuner.on_sent()
                self.tuner.on_factor()
            self.tuner.observe(self.used, self.made, self.costs[self.used])
            found.append(self.used)
            self.step += 1
        return found


@pytest.mark.parametrize(("costs", "better"), [((1.0, 2.0), IC), ((2.0, 1.0), EXACT)])
def test_the_cheaper_one_is_found_within_a_few_factors_and_kept(costs, better):
    bench = Bench(*costs)
    bench.run(3 * MIN_SOLVES + 5 * bench.life)
    assert bench.tuner.current == better
    assert bench.run(TRIAL_INTERVAL // 2).count(better) > 0.8 * TRIAL_INTERVAL // 2


def test_what_is_no_gain_is_tried_less_and_less_often():
    bench = Bench(1.0, 1.05)
    used = bench.run(80 * TRIAL_INTERVAL)
    begins = [i for i, (a, b) in enumerate(itertools.pairwise(used)) if (a, b) == (IC, EXACT)]
    gaps = [b - a for a, b in itertools.pairwise(begins)]
    assert gaps[0] > TRIAL_INTERVAL and all(b > 1.5 * a or b > MAX_TRIAL_INTERVAL for a, b in itertools.pairwise(gaps))
    assert used.count(EXACT) < 0.02 * len(used)


def test_a_trial_that_is_clearly_worse_ends_with_its_first_factor():
    bench = Bench(1.0, 3.0)
    assert bench.run(TRIAL_INTERVAL).count(EXACT) == bench.life


@pytest.mark.parametrize("life", [1, 2])
def test_factors_that_live_for_a_solve_or_two_are_tried_too(life):
    bench = Bench(2.0, 1.0, life)
    bench.run(6 * MIN_SOLVES)
    assert bench.tuner.current == EXACT
    bench = Bench(1.0, 3.0, life)
    assert bench.run(TRIAL_INTERVAL).count(EXACT) == life


def test_factors_that_live_long_are_judged_all_the_same():
    bench = Bench(2.0, 1.0, life=1000)
    bench.run(1000 + FIRST_SOLVES + MAX_SOLVES)
    assert bench.tuner.current == EXACT


def test_it_follows_when_costs_change():
    bench = Bench(1.0, 2.0)
    bench.run(2 * TRIAL_INTERVAL)
    bench.costs = {IC: 2.0, EXACT: 1.0}
    bench.run(3 * TRIAL_INTERVAL)
    assert bench.tuner.current == EXACT


def test_equal_costs_make_no_changes():
    bench = Bench(1.0, 1.0)
    bench.run(20 * TRIAL_INTERVAL)
    assert bench.tuner.current == IC


def test_a_method_whose_jobs_fail_is_left():
    tuner = FactorizationTuner([IC, EXACT])

    def fail(times: int) -> None:
        for _ in range(times):
            tuner.on_sent()
            tuner.on_failure()

    fail(MAX_FAILURES - 1)
    tuner.on_sent()
    tuner.on_factor()
    fail(1)
    assert tuner.method == IC, "not in a row"
    fail(1)
    assert tuner.method == tuner.current == EXACT
    fail(3 * MAX_FAILURES)  # nothing is left to go over to
    assert tuner.method == EXACT


@pytest.mark.parametrize(("factors", "method"), [(0, EXACT), (1, IC)])
def test_the_exact_factor_is_asked_for_at_once_where_the_first_one_is_refused(factors, method):
    tuner = FactorizationTuner([IC, EXACT])
    for _ in range(factors):
        tuner.on_sent()
        tuner.on_factor()
    tuner.on_sent()
    tuner.on_failure(refused=True)
    assert tuner.method == method


def test_a_trial_whose_job_fails_is_over():
    tuner = FactorizationTuner([IC, EXACT])
    for step in range(MIN_SOLVES):
        tuner.observe(IC, step, 1.0)
    assert tuner.method == EXACT
    tuner.on_sent()
    tuner.on_failure()
    assert tuner.method == tuner.current == IC
    assert not any(tuner.observe(IC, step, 1.0) for step in range(TRIAL_INTERVAL - 1)) and tuner.method == IC


def test_one_method_alone_is_never_left():
    tuner = FactorizationTuner([EXACT])
    for step in range(3 * TRIAL_INTERVAL):
        assert not tuner.observe(EXACT, step, 1.0)
    assert tuner.method == EXACT


def test_where_block_jacobi_wins_both_are_compared_with_it():
    tuner, tried = PreconditionerTuner([IC, EXACT]), []
    for step in range(4 * TRIAL_INTERVAL):
        if step % 5 == 0 and step:
            tuner.on_factor(tuner.factorization.method)
        if tuner.kind is Kind.CHOLESKY:
            tried.append(tuner.factorization.method)
            tuner.observe(Kind.BLOCK_JACOBI, 20, 20.0, Kind.CHOLESKY, (tuner.factorization.method, step))
        else:
            tuner.observe(Kind.BLOCK_JACOBI, 10, 10.0, Kind.BLOCK_JACOBI)
    assert tried[:2] == [IC, EXACT] and len(tried) <= 4 * TRIAL_INTERVAL // 50
    assert tuner.kind is Kind.BLOCK_JACOBI


def test_the_factor_that_beat_block_jacobi_stays():
    tuner = PreconditionerTuner([IC, EXACT])
    for _ in range(5):
        tuner.observe(Kind.BLOCK_JACOBI, 100, 100.0)
    tuner.on_factor(IC)
    tuner.observe(Kind.CHOLESKY, 8, 10.0, Kind.CHOLESKY, (IC, 3))
    assert (tuner.kind, tuner.factorization.method) == (Kind.CHOLESKY, IC)


def test_solves_of_a_trial_say_nothing_of_the_factor_in_use():
    """Else a trial that is worse would call for a probe of block Jacobi."""
    tuner = PreconditionerTuner([IC, EXACT])
    for _ in range(5):
        tuner.observe(Kind.BLOCK_JACOBI, 100, 100.0)
    tuner.on_factor(IC)
    for step in range(MIN_SOLVES + SETTLE):
        tuner.observe(Kind.CHOLESKY, 8, 10.0, Kind.CHOLESKY, (IC, step))
    assert tuner.factorization.method == EXACT
    for step in range(2):
        tuner.observe(Kind.CHOLESKY, 40, 50.0, Kind.CHOLESKY, (EXACT, 100 + step))
    assert (tuner.kind, tuner.probe) == (Kind.CHOLESKY, 0)
