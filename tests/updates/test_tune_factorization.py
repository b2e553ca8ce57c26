# SPDX-License-Identifier: MIT
"""Which factor "auto" asks for, as a state machine: costs of solves go in, the method of the next job comes out."""

import itertools

import pytest

from protocol.method import Method
from sim_server.backends.cpu.engine import Kind
from sim_server.updates.tune_factorization import EARLY, EVERY, FAILURES, LONG, RARELY, SOLVES, SOON, Making
from sim_server.updates.tune_preconditioner import Choice

IC, EXACT = Method("incomplete_cholesky", drop_tolerance=0.003, fill=10), Method()


class Bench:
    """A worker that makes a factor each `life` solves of whatever is asked for; costs: of a solve by method."""

    def __init__(self, incomplete: float, exact: float, life: int = 4):
        self.costs, self.life = {IC: incomplete, EXACT: exact}, life
        self.making = Making([IC, EXACT])
        self.step, self.made, self.used = 0, 0, self.making.method

    def run(self, solves: int) -> list[Method]:
        """Methods of the factors that they used."""
        found = []
        for _ in range(solves):
            if self.step % self.life == 0:
                self.made, self.used = self.step, self.making.method
                self.making.sent()
                self.making.answered()
            self.making.observe(self.used, self.made, self.costs[self.used])
            found.append(self.used)
            self.step += 1
        return found


@pytest.mark.parametrize(("costs", "better"), [((1.0, 2.0), IC), ((2.0, 1.0), EXACT)])
def test_the_cheaper_one_is_found_within_a_few_factors_and_kept(costs, better):
    bench = Bench(*costs)
    bench.run(3 * SOLVES + 5 * bench.life)
    assert bench.making.decided == better
    assert bench.run(EVERY // 2).count(better) > 0.8 * EVERY // 2


def test_what_is_no_gain_is_tried_less_and_less_often():
    bench = Bench(1.0, 1.05)
    used = bench.run(80 * EVERY)
    begins = [i for i, (a, b) in enumerate(itertools.pairwise(used)) if (a, b) == (IC, EXACT)]
    gaps = [b - a for a, b in itertools.pairwise(begins)]
    assert gaps[0] > EVERY and all(b > 1.5 * a or b > RARELY for a, b in itertools.pairwise(gaps))
    assert used.count(EXACT) < 0.02 * len(used)


def test_a_trial_that_is_clearly_worse_ends_with_its_first_factor():
    bench = Bench(1.0, 3.0)
    assert bench.run(EVERY).count(EXACT) == bench.life


@pytest.mark.parametrize("life", [1, 2])
def test_factors_that_live_for_a_solve_or_two_are_tried_too(life):
    bench = Bench(2.0, 1.0, life)
    bench.run(6 * SOLVES)
    assert bench.making.decided == EXACT
    bench = Bench(1.0, 3.0, life)
    assert bench.run(EVERY).count(EXACT) == life


def test_factors_that_live_long_are_judged_all_the_same():
    bench = Bench(2.0, 1.0, life=1000)
    bench.run(1000 + EARLY + LONG)
    assert bench.making.decided == EXACT


def test_it_follows_when_costs_change():
    bench = Bench(1.0, 2.0)
    bench.run(2 * EVERY)
    bench.costs = {IC: 2.0, EXACT: 1.0}
    bench.run(3 * EVERY)
    assert bench.making.decided == EXACT


def test_equal_costs_make_no_changes():
    bench = Bench(1.0, 1.0)
    bench.run(20 * EVERY)
    assert bench.making.decided == IC


def test_a_method_whose_jobs_fail_is_left():
    making = Making([IC, EXACT])

    def fail(times: int) -> None:
        for _ in range(times):
            making.sent()
            making.failed()

    fail(FAILURES - 1)
    making.sent()
    making.answered()
    fail(1)
    assert making.method == IC, "not in a row"
    fail(1)
    assert making.method == making.decided == EXACT
    fail(3 * FAILURES)  # nothing is left to go over to
    assert making.method == EXACT


def test_a_trial_whose_job_fails_is_over():
    making = Making([IC, EXACT])
    for step in range(SOLVES):
        making.observe(IC, step, 1.0)
    assert making.method == EXACT
    making.sent()
    making.failed()
    assert making.method == making.decided == IC
    assert not any(making.observe(IC, step, 1.0) for step in range(EVERY - 1)) and making.method == IC


def test_one_method_alone_is_never_left():
    making = Making([EXACT])
    for step in range(3 * EVERY):
        assert not making.observe(EXACT, step, 1.0)
    assert making.method == EXACT


def test_where_block_jacobi_wins_both_are_compared_with_it():
    choice, tried = Choice([IC, EXACT]), []
    for step in range(4 * EVERY):
        if step % 5 == 0 and step:
            choice.factor_arrived(choice.making.method)
        if choice.kind is Kind.CHOLESKY:
            tried.append(choice.making.method)
            choice.observe(Kind.BLOCK_JACOBI, 20, 20.0, Kind.CHOLESKY, (choice.making.method, step))
        else:
            choice.observe(Kind.BLOCK_JACOBI, 10, 10.0, Kind.BLOCK_JACOBI)
    assert tried[:2] == [IC, EXACT] and len(tried) <= 4 * EVERY // 50
    assert choice.kind is Kind.BLOCK_JACOBI


def test_the_factor_that_beat_block_jacobi_stays():
    choice = Choice([IC, EXACT])
    for _ in range(5):
        choice.observe(Kind.BLOCK_JACOBI, 100, 100.0)
    choice.factor_arrived(IC)
    choice.observe(Kind.CHOLESKY, 8, 10.0, Kind.CHOLESKY, (IC, 3))
    assert (choice.kind, choice.making.method) == (Kind.CHOLESKY, IC)


def test_solves_of_a_trial_say_nothing_of_the_factor_in_use():
    """Else a trial that is worse would call for a probe of block Jacobi."""
    choice = Choice([IC, EXACT])
    for _ in range(5):
        choice.observe(Kind.BLOCK_JACOBI, 100, 100.0)
    choice.factor_arrived(IC)
    for step in range(SOLVES + SOON):
        choice.observe(Kind.CHOLESKY, 8, 10.0, Kind.CHOLESKY, (IC, step))
    assert choice.making.method == EXACT
    for step in range(2):
        choice.observe(Kind.CHOLESKY, 40, 50.0, Kind.CHOLESKY, (EXACT, 100 + step))
    assert (choice.kind, choice.probe) == (Kind.CHOLESKY, 0)
