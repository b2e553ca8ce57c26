# SPDX-License-Identifier: MIT
"""preconditioner = "auto" as a state machine: solves go in, the kind of the next one comes out."""

import itertools

import pytest

from sim_server.backends.cpu.engine import Kind
from sim_server.updates.convergence import Reached
from sim_server.updates.tune_preconditioner import EVERY, RARELY, Choice

BJ, CH, NONE = Kind.BLOCK_JACOBI, Kind.CHOLESKY, Kind.NONE


class Bench:
    """Solves of a world where block Jacobi and the factor take so many iterations of such a cost each."""

    def __init__(self, block_jacobi: tuple[int, float], factor: tuple[int, float]):
        self.costs = {BJ: block_jacobi, CH: factor}
        self.choice = Choice()

    def solve(self) -> Kind:
        """One solve as the loop would make it, reported; returns the kind that it began with."""
        asked, probe = self.choice.kind, self.choice.probe
        iterations, each = self.costs[asked]
        if probe and iterations > probe:  # given up: over to the other
            other = BJ if asked is CH else CH
            more, its_cost = self.costs[other]
            self.choice.observe(other, probe + more, probe * each + more * its_cost, asked)
        else:
            self.choice.observe(asked, iterations, iterations * each, asked)
        return asked

    def run(self, solves: int) -> list[Kind]:
        return [self.solve() for _ in range(solves)]


HARD = ((100, 1.0), (5, 5.0))  # the factor costs a quarter
EASY = ((8, 1.0), (5, 5.0))  # the factor costs three times as much


def test_without_a_factor_it_is_block_jacobi_for_ever():
    bench = Bench(*HARD)
    assert set(bench.run(3 * EVERY)) == {BJ}
    assert bench.choice.probe == 0


def test_the_first_factor_is_tried_at_once_and_kept_where_it_is_better():
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    assert (bench.choice.kind, bench.choice.probe) == (CH, 100)
    assert set(bench.run(EVERY)) == {CH}


def test_a_factor_that_is_no_gain_costs_one_solve_of_at_most_twice_the_cost():
    bench = Bench(*EASY)
    bench.run(10)
    bench.choice.factor_arrived()
    assert bench.choice.probe == 8  # as many iterations as block Jacobi's whole solve
    assert bench.run(1) == [CH]
    assert set(bench.run(EVERY - 1)) == {BJ}


def test_a_factor_that_comes_before_any_solve_is_used_as_there_is_nothing_to_compare():
    bench = Bench(*EASY)
    bench.choice.factor_arrived()
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)
    assert bench.run(1) == [CH]
    assert bench.choice.kind is CH


def test_what_lost_is_probed_again_less_and_less_often():
    bench = Bench(*EASY)
    bench.run(10)
    bench.choice.factor_arrived()
    kinds = bench.run(60 * EVERY)
    probes = [i for i, kind in enumerate(kinds) if kind is CH]
    gaps = [b - a for a, b in itertools.pairwise(probes)]
    assert probes[0] == 0
    assert gaps[:3] == [2 * EVERY + 1, 4 * EVERY + 1, 8 * EVERY + 1]
    assert max(gaps) <= RARELY + 1


def test_what_won_is_challenged_too():
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    kinds = bench.run(EVERY + 5)
    assert kinds.count(BJ) == 1  # one probe of block Jacobi
    assert kinds[-1] is CH


@pytest.mark.parametrize(("before", "after", "kinds"), [(EASY, HARD, (BJ, CH)), (HARD, EASY, (CH, BJ))])
def test_it_follows_when_the_scene_changes(before, after, kinds):
    bench = Bench(*before)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(50)
    assert bench.choice.kind is kinds[0]
    bench.costs = dict(zip((BJ, CH), after, strict=True))
    bench.run(4 * EVERY)
    assert bench.choice.kind is kinds[1]


def test_solves_that_become_harder_are_reason_to_probe_at_once():
    bench = Bench(*EASY)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(20)
    bench.costs = dict(zip((BJ, CH), HARD, strict=True))
    assert CH in bench.run(5)
    assert bench.choice.kind is CH


def test_a_new_factor_makes_a_probe_come_sooner():
    bench = Bench(*EASY)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(EVERY // 4)
    bench.choice.factor_arrived()
    assert bench.choice.kind is BJ  # the last probe was not long enough ago
    bench.run(3)
    bench.choice.factor_arrived()
    assert bench.choice.kind is CH


def test_equal_costs_do_not_make_it_swing():
    bench = Bench((10, 1.0), (5, 2.0))
    bench.run(10)
    bench.choice.factor_arrived()
    kinds = bench.run(10 * EVERY)
    assert sum(a is not b for a, b in itertools.pairwise(kinds)) <= 12
    assert kinds.count(CH) <= 6


def test_reports_from_before_a_probe_do_not_end_it():
    """Where the loop runs on while reports are read, the first ones after a change are of older settings."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    for _ in range(4):
        bench.choice.observe(BJ, 100, 100.0, asked=BJ)
        assert (bench.choice.kind, bench.choice.probe) == (CH, 100)
    bench.choice.observe(CH, 5, 25.0, asked=CH)
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)


def test_a_factor_that_was_useless_ends_its_probe():
    """It fell back to block Jacobi: reported with that kind."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.choice.observe(BJ, 101, 105.0, asked=CH)
    assert (bench.choice.kind, bench.choice.probe) == (BJ, 0)


def test_solves_without_iterations_and_of_other_kinds_do_no_harm():
    bench = Bench(*HARD)
    for _ in range(5):
        bench.choice.observe(BJ, 0, 0.0)
        bench.choice.observe(NONE, 5, 1.0)
    bench.choice.factor_arrived()
    assert bench.choice.kind is CH
    bench.choice.observe(CH, 0, 0.0)
    assert bench.choice.kind in (BJ, CH)


def cut_off(lack: float, used: float = 1.0) -> Reached:
    """A solve that used up what it was allowed; lack: decades of the residual wanted by those gained."""
    return Reached(lack, used)


def tried(choice: Choice, before: Reached, found: Reached, cost: float) -> Kind:
    """What is in use after the first factor was tried, whose solve cost so much; one of block Jacobi costs 1."""
    for _ in range(10):
        choice.observe(BJ, 10, 1.0, BJ, reached=before)
    choice.factor_arrived()
    assert choice.kind is CH
    choice.observe(CH, 3, cost, CH, (None, 4), reached=found)
    return choice.kind


def test_a_solve_that_is_cut_off_is_not_cheap():
    """Ten iterations of block Jacobi cost a tenth of what the factor takes, and gain a third of a decade."""
    choice = Choice()
    assert tried(choice, before=cut_off(17.0), found=Reached(0.0, 0.3), cost=10.0) is CH
    for _ in range(3 * EVERY):  # and its probes change nothing
        asked = choice.kind
        if asked is BJ:
            choice.observe(CH, choice.probe + 3, 11.0, BJ, (None, 4), reached=Reached(0.0, 0.9))
        else:
            choice.observe(CH, 3, 10.0, CH, (None, 4), reached=Reached(0.0, 0.3))
        assert choice.kind is CH or choice.probe


def test_a_factor_that_is_cut_off_is_no_gain_on_what_converges():
    assert tried(Choice(), before=Reached(0.0, 0.9), found=cut_off(2.0), cost=0.1) is BJ


@pytest.mark.parametrize(("cost", "kind"), [(1.5, CH), (3.5, BJ)])
def test_where_nothing_converges_the_cost_of_a_decade_decides(cost, kind):
    """Block Jacobi gains a sixth of what is wanted for 1, the factor half of it for `cost`."""
    assert tried(Choice(), before=cut_off(6.0), found=cut_off(2.0), cost=cost) is kind


def test_what_does_not_converge_sets_no_limit_to_a_probe():
    choice = Choice()
    for _ in range(10):
        choice.observe(BJ, 10, 1.0, BJ, reached=cut_off(17.0))
    choice.factor_arrived()
    assert (choice.kind, choice.probe) == (CH, 0)


@pytest.mark.parametrize(("used", "room"), [(0.01, 33), (0.3, 5), (0.7, None)])
def test_a_probe_of_block_jacobi_leaves_the_factor_what_it_needs(used, room):
    """Three iterations with the factor use `used` of what a solve is allowed; block Jacobi's cost a tenth of theirs."""
    choice = Choice()
    for _ in range(10):
        choice.observe(BJ, 100, 100.0, BJ)
    choice.factor_arrived()
    kinds = set()
    for _ in range(EVERY + 1):
        choice.observe(CH, 3, 33.0, CH, (None, 4), reached=Reached(0.0, used))
        if (kind := choice.kind) is BJ:
            break
        kinds.add(kind)
    assert (kind is BJ) == (room is not None)
    assert choice.probe == (room or 0)
    assert room is None or room == 33 or room * used / 3 + used < 1


def test_one_solve_cut_off_is_no_reason_to_change():
    """The system may have held the server up for the whole budget of a step."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(20)
    bench.choice.observe(CH, 1, 20.0, CH, (None, 4), reached=cut_off(3.0))
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)
    bench.choice.observe(CH, 1, 20.0, CH, (None, 4), reached=cut_off(3.0))
    assert bench.choice.kind is BJ  # two in a row are


def test_a_probe_waits_for_a_factor_that_is_still_on_its_way():
    """The loop was asked to begin with it before it had it: that is no answer."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.choice.observe(BJ, 100, 100.0, CH, (None, -1))
    assert bench.choice.kind is CH and bench.choice.probe
    bench.choice.observe(CH, 5, 25.0, CH, (None, 4))
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)


def test_reports_from_before_a_probe_begin_no_other_one():
    """A solve that the system held up begins a probe; those before it that are still to be reported are slow too."""
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(20)
    bench.choice.observe(CH, 5, 1000.0, CH, (None, 4))
    probe = bench.choice.probe
    assert bench.choice.kind is BJ and probe
    for _ in range(3):
        bench.choice.observe(CH, 5, 1000.0, CH, (None, 4))
        assert (bench.choice.kind, bench.choice.probe) == (BJ, probe)
    bench.choice.observe(CH, probe + 5, 1000.0, BJ, (None, 4))  # the probe, given up
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)
    bench.choice.observe(CH, probe + 5, 1e9, BJ, (None, 4))  # one more step began before that was known
    assert (bench.choice.kind, bench.choice.probe) == (CH, 0)


def test_a_factor_that_is_always_left_is_not_kept():
    bench = Bench(*HARD)
    bench.run(10)
    bench.choice.factor_arrived()
    bench.run(20)
    for _ in range(5):
        if bench.choice.kind is CH:
            bench.choice.observe(BJ, 350, 500.0, CH, (None, 4), fallbacks=1)
    assert bench.choice.kind is BJ
