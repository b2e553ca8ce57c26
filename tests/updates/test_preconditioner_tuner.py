# SPDX-License-Identifier: MIT
"""preconditioner = "auto" as a state machine: solves go in, the kind of the next one comes out."""

import itertools

import pytest

from sim_server.backends.kinds import Kind
from sim_server.updates.autotune.convergence import Convergence
from sim_server.updates.autotune.preconditioner import PreconditionerTuner
from sim_server.updates.autotune.tuner import MAX_TRIAL_INTERVAL, TRIAL_INTERVAL

BJ, CH, NONE = Kind.BLOCK_JACOBI, Kind.CHOLESKY, Kind.NONE


class Bench:
    """Solves of a world where block Jacobi and the factor take so many iterations of such a cost each."""

    def __init__(self, block_jacobi: tuple[int, float], factor: tuple[int, float]):
        self.costs = {BJ: block_jacobi, CH: factor}
        self.tuner = PreconditionerTuner()

    def solve(self) -> Kind:
        """One solve as the loop would make it, reported; returns the kind that it began with."""
        asked, probe = self.tuner.kind, self.tuner.probe
        iterations, each = self.costs[asked]
        if probe and iterations > probe:  # given up: over to the other
            other = BJ if asked is CH else CH
            more, its_cost = self.costs[other]
            self.tuner.observe(other, probe + more, probe * each + more * its_cost, asked)
        else:
            self.tuner.observe(asked, iterations, iterations * each, asked)
        return asked

    def run(self, solves: int) -> list[Kind]:
        return [self.solve() for _ in range(solves)]


HARD = ((100, 1.0), (5, 5.0))  # the factor costs a quarter
EASY = ((8, 1.0), (5, 5.0))  # the factor costs three times as much


def test_without_a_factor_it_is_block_jacobi_for_ever():
    bench = Bench(*HARD)
    assert set(bench.run(3 * TRIAL_INTERVAL)) == {BJ}
    assert bench.tuner.probe == 0


def test_the_first_factor_is_tried_at_once_and_kept_where_it_is_better():
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 100)
    assert set(bench.run(TRIAL_INTERVAL)) == {CH}


def test_a_factor_that_is_no_gain_costs_one_solve_of_at_most_twice_the_cost():
    bench = Bench(*EASY)
    bench.run(10)
    bench.tuner.on_factor()
    assert bench.tuner.probe == 8  # as many iterations as block Jacobi's whole solve
    assert bench.run(1) == [CH]
    assert set(bench.run(TRIAL_INTERVAL - 1)) == {BJ}


def test_a_factor_that_comes_before_any_solve_is_used_as_there_is_nothing_to_compare():
    bench = Bench(*EASY)
    bench.tuner.on_factor()
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)
    assert bench.run(1) == [CH]
    assert bench.tuner.kind is CH


def test_what_lost_is_probed_again_less_and_less_often():
    bench = Bench(*EASY)
    bench.run(10)
    bench.tuner.on_factor()
    kinds = bench.run(60 * TRIAL_INTERVAL)
    probes = [i for i, kind in enumerate(kinds) if kind is CH]
    gaps = [b - a for a, b in itertools.pairwise(probes)]
    assert probes[0] == 0
    assert gaps[:3] == [2 * TRIAL_INTERVAL + 1, 4 * TRIAL_INTERVAL + 1, 8 * TRIAL_INTERVAL + 1]
    assert max(gaps) <= MAX_TRIAL_INTERVAL + 1


def test_what_won_is_challenged_too():
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    kinds = bench.run(TRIAL_INTERVAL + 5)
    assert kinds.count(BJ) == 1  # one probe of block Jacobi
    assert kinds[-1] is CH


@pytest.mark.parametrize(("before", "after", "kinds"), [(EASY, HARD, (BJ, CH)), (HARD, EASY, (CH, BJ))])
def test_it_follows_when_the_scene_changes(before, after, kinds):
    bench = Bench(*before)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(50)
    assert bench.tuner.kind is kinds[0]
    bench.costs = dict(zip((BJ, CH), after, strict=True))
    bench.run(4 * TRIAL_INTERVAL)
    assert bench.tuner.kind is kinds[1]


def test_solves_that_become_harder_are_reason_to_probe_at_once():
    bench = Bench(*EASY)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(20)
    bench.costs = dict(zip((BJ, CH), HARD, strict=True))
    assert CH in bench.run(5)
    assert bench.tuner.kind is CH


def test_a_new_factor_makes_a_probe_come_sooner():
    bench = Bench(*EASY)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(TRIAL_INTERVAL // 4)
    bench.tuner.on_factor()
    assert bench.tuner.kind is BJ  # the last probe was not long enough ago
    bench.run(3)
    bench.tuner.on_factor()
    assert bench.tuner.kind is CH


def test_equal_costs_do_not_make_it_swing():
    bench = Bench((10, 1.0), (5, 2.0))
    bench.run(10)
    bench.tuner.on_factor()
    kinds = bench.run(10 * TRIAL_INTERVAL)
    assert sum(a is not b for a, b in itertools.pairwise(kinds)) <= 12
    assert kinds.count(CH) <= 6


def test_reports_from_before_a_probe_do_not_end_it():
    """Where the loop runs on while reports are read, the first ones after a change are of older settings."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    for _ in range(4):
        bench.tuner.observe(BJ, 100, 100.0, requested=BJ)
        assert (bench.tuner.kind, bench.tuner.probe) == (CH, 100)
    bench.tuner.observe(CH, 5, 25.0, requested=CH)
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)


def test_a_factor_that_was_useless_ends_its_probe():
    """It fell back to block Jacobi: reported with that kind."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    bench.tuner.observe(BJ, 101, 105.0, requested=CH)
    assert (bench.tuner.kind, bench.tuner.probe) == (BJ, 0)


def test_solves_without_iterations_and_of_other_kinds_do_no_harm():
    bench = Bench(*HARD)
    for _ in range(5):
        bench.tuner.observe(BJ, 0, 0.0)
        bench.tuner.observe(NONE, 5, 1.0)
    bench.tuner.on_factor()
    assert bench.tuner.kind is CH
    bench.tuner.observe(CH, 0, 0.0)
    assert bench.tuner.kind in (BJ, CH)


def cut_off(shortfall: float, used: float = 1.0) -> Convergence:
    """A solve that used up what it was allowed; shortfall: decades of the residual wanted by those gained."""
    return Convergence(shortfall, used)


def tried(tuner: PreconditionerTuner, before: Convergence, found: Convergence, cost: float) -> Kind:
    """What is in use after the first factor was tried, whose solve cost so much; one of block Jacobi costs 1."""
    for _ in range(10):
        tuner.observe(BJ, 10, 1.0, BJ, convergence=before)
    tuner.on_factor()
    assert tuner.kind is CH
    tuner.observe(CH, 3, cost, CH, (None, 4), convergence=found)
    return tuner.kind


def test_a_solve_that_is_cut_off_is_not_cheap():
    """Ten iterations of block Jacobi cost a tenth of what the factor takes, and gain a third of a decade."""
    tuner = PreconditionerTuner()
    assert tried(tuner, before=cut_off(17.0), found=Convergence(0.0, 0.3), cost=10.0) is CH
    for _ in range(3 * TRIAL_INTERVAL):  # and its probes change nothing
        asked = tuner.kind
        if asked is BJ:
            tuner.observe(CH, tuner.probe + 3, 11.0, BJ, (None, 4), convergence=Convergence(0.0, 0.9))
        else:
            tuner.observe(CH, 3, 10.0, CH, (None, 4), convergence=Convergence(0.0, 0.3))
        assert tuner.kind is CH or tuner.probe


def test_a_factor_that_is_cut_off_is_no_gain_on_what_converges():
    assert tried(PreconditionerTuner(), before=Convergence(0.0, 0.9), found=cut_off(2.0), cost=0.1) is BJ


@pytest.mark.parametrize(("cost", "kind"), [(1.5, CH), (3.5, BJ)])
def test_where_nothing_converges_the_cost_of_a_decade_decides(cost, kind):
    """Block Jacobi gains a sixth of what is wanted for 1, the factor half of it for `cost`."""
    assert tried(PreconditionerTuner(), before=cut_off(6.0), found=cut_off(2.0), cost=cost) is kind


def test_what_does_not_converge_sets_no_limit_to_a_probe():
    tuner = PreconditionerTuner()
    for _ in range(10):
        tuner.observe(BJ, 10, 1.0, BJ, convergence=cut_off(17.0))
    tuner.on_factor()
    assert (tuner.kind, tuner.probe) == (CH, 0)


@pytest.mark.parametrize(("used", "room"), [(0.01, 33), (0.3, 5), (0.7, None)])
def test_a_probe_of_block_jacobi_leaves_the_factor_what_it_needs(used, room):
    """Three iterations with the factor use `used` of what a solve is allowed; block Jacobi's cost a tenth of theirs."""
    tuner = PreconditionerTuner()
    for _ in range(10):
        tuner.observe(BJ, 100, 100.0, BJ)
    tuner.on_factor()
    kinds = set()
    for _ in range(TRIAL_INTERVAL + 1):
        tuner.observe(CH, 3, 33.0, CH, (None, 4), convergence=Convergence(0.0, used))
        if (kind := tuner.kind) is BJ:
            break
        kinds.add(kind)
    assert (kind is BJ) == (room is not None)
    assert tuner.probe == (room or 0)
    assert room is None or room == 33 or room * used / 3 + used < 1


def test_one_solve_cut_off_is_no_reason_to_change():
    """The system may have held the server up for the whole budget of a step."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(20)
    bench.tuner.observe(CH, 1, 20.0, CH, (None, 4), convergence=cut_off(3.0))
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)
    bench.tuner.observe(CH, 1, 20.0, CH, (None, 4), convergence=cut_off(3.0))
    assert bench.tuner.kind is BJ  # two in a row are


def test_a_probe_waits_for_a_factor_that_is_still_on_its_way():
    """The loop was asked to begin with it before it had it: that is no answer."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    bench.tuner.observe(BJ, 100, 100.0, CH, (None, -1))
    assert bench.tuner.kind is CH and bench.tuner.probe
    bench.tuner.observe(CH, 5, 25.0, CH, (None, 4))
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)


def test_reports_from_before_a_probe_begin_no_other_one():
    """A solve that the system held up begins a probe; those before it that are still to be reported are slow too."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(20)
    bench.tuner.observe(CH, 5, 1000.0, CH, (None, 4))
    probe = bench.tuner.probe
    assert bench.tuner.kind is BJ and probe
    for _ in range(3):
        bench.tuner.observe(CH, 5, 1000.0, CH, (None, 4))
        assert (bench.tuner.kind, bench.tuner.probe) == (BJ, probe)
    bench.tuner.observe(CH, probe + 5, 1000.0, BJ, (None, 4))  # the probe, given up
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)
    bench.tuner.observe(CH, probe + 5, 1e9, BJ, (None, 4))  # one more step began before that was known
    assert (bench.tuner.kind, bench.tuner.probe) == (CH, 0)


def test_a_factor_that_is_always_left_is_not_kept():
    bench = Bench(*HARD)
    bench.run(10)
    bench.tuner.on_factor()
    bench.run(20)
    for _ in range(5):
        if bench.tuner.kind is CH:
            bench.tuner.observe(BJ, 350, 500.0, CH, (None, 4), fallbacks=1)
    assert bench.tuner.kind is BJ
