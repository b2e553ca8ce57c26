# SPDX-License-Identifier: MIT
"""warp = "auto" as a state machine: solves go in, whether the next one is held comes out."""

from collections.abc import Callable

import numpy as np
import pytest

from sim_server.warping import AFTER, EVERY, SAMPLES, SHARE, TRIALS, Solve, Warping, alike, expected

Cost = Callable[[int, int], float]  # iterations of a solve in a step with a factor so old


class Bench:
    """A world where following and holding take so many iterations, under lockstep-D (0: one factor for ever)."""

    def __init__(self, follow: Cost, hold: Cost, latency: int = 3, turned: float = 0.03):
        self.costs, self.latency, self.turned = {False: follow, True: hold}, latency, turned
        self.warping = Warping()
        self.step, self.iterations, self.asked = 0, 0, 0

    def solve(self) -> bool:
        """One solve as the loop would make it, reported; True if it was held."""
        d, held = self.latency, self.warping.hold
        made = d * (self.step // d - 1) if d else 0
        if made >= 0:
            iterations = round(self.costs[held](self.step, self.step - made))
            self.iterations += iterations
            self.warping.observe(self.step, made, iterations, held)
            self.warping.consider(self._turned)
        self.step += 1
        return held

    def _turned(self) -> float:
        self.asked += 1
        return self.turned

    def run(self, solves: int) -> int:
        """How many of them were held."""
        return sum(self.solve() for _ in range(solves))


def flat(iterations: float) -> Cost:
    return lambda step, age: iterations


def ageing(fresh: float, slope: float) -> Cost:
    return lambda step, age: fresh + slope * age


def swinging(cost: Cost, by: float, period: float) -> Cost:
    """As an oscillating body has it."""
    return lambda step, age: cost(step, age) * (1 + by * np.sin(2 * np.pi * step / period))


def total(cost: Cost, solves: int, latency: int) -> float:
    bench = Bench(cost, cost, latency)
    bench.run(solves)
    return bench.iterations


def test_it_begins_by_following():
    assert Bench(flat(10), flat(5)).run(SAMPLES) == 0


@pytest.mark.parametrize("latency", [0, 1, 3, 10, 30])
def test_holding_is_found_where_it_is_better(latency):
    bench = Bench(ageing(14, 0.02), ageing(12, 0.02), latency)
    bench.run(2 * latency + EVERY + 2 * TRIALS[0] * (SAMPLES + EVERY) + 4 * latency)
    assert bench.warping.decided
    assert bench.run(400) > 320


@pytest.mark.parametrize("latency", [0, 1, 3, 10])
@pytest.mark.parametrize("factor", [1.0, 1.02, 1.3, 3.0, 12.0])
def test_following_stays_where_it_is_not_worse_and_trials_cost_little(factor, latency):
    follow, hold = ageing(6, 0.05), ageing(6 * factor, 0.05)
    bench = Bench(follow, hold, latency)
    bench.run(600)
    assert not bench.warping.decided
    once = 6 * factor  # a trial may have begun with what was left of the share
    assert bench.iterations < (1 + SHARE) * total(follow, 600, latency) + once + 3
    assert bench.warping.lost <= SHARE * bench.iterations + once + 3


CASES = [
    (ageing(5, 0.2), ageing(5, 1.0)), (ageing(6, 0.14), ageing(6, 0.1)), (flat(12), flat(10)), (flat(10), flat(12)),
    (swinging(flat(14), 0.2, 79), swinging(flat(12), 0.2, 79)), (swinging(ageing(4, 0.1), 0.5, 23), ageing(7, 0.3)),
    (lambda step, age: 9 * 0.995**step + 3, lambda step, age: 10 * 0.995**step + 3),
]  # fmt: skip


@pytest.mark.parametrize("latency", [0, 3, 10, 30])
@pytest.mark.parametrize("case", range(len(CASES)))
def test_it_is_within_five_percent_of_the_better_one(case, latency):
    follow, hold = CASES[case]
    if latency == 0:  # a factor for ever: what grows with its age would grow for ever
        follow, hold = (lambda step, age, cost=cost: cost(step, age % 40) for cost in (follow, hold))
    bench = Bench(follow, hold, latency)
    bench.run(500)
    assert bench.iterations <= 1.05 * min(total(follow, 500, latency), total(hold, 500, latency))


def test_holding_is_not_tried_where_nodes_have_turned_far_or_not_at_all():
    for turned in (0.5, 0.0):
        bench = Bench(flat(14), flat(12), turned=turned)
        assert bench.run(300) == 0
        assert 300 / EVERY / 2 < bench.asked <= 300 / EVERY
        assert bench.warping.trials == 0


def test_what_was_no_gain_is_tried_less_and_less_often():
    bench = Bench(flat(6), flat(6.6))
    held = [k for k in range(4000) if bench.solve()]
    begins = [k for k in held if k - 1 not in held]
    assert len(begins) == bench.warping.trials and 4 < len(begins) < 12
    gaps = np.diff(begins)
    assert (gaps[1:] > 1.5 * gaps[:-1]).all()


def test_a_held_body_whose_solves_become_harder_follows_again_soon():
    bench = Bench(flat(14), flat(12))
    bench.run(600)
    assert bench.warping.decided
    bench.costs[True] = flat(30)
    bench.run(2 * SAMPLES + 2)
    assert not bench.warping.hold  # in a trial at least
    bench.run(AFTER)
    assert not bench.warping.decided


def test_solves_are_compared_with_those_that_say_most_about_them():
    """As old a factor in the last epoch, if it is short; else the ones next in time."""
    epochs = [Solve(k, k % 3 + 3, 10 * (k % 3) + k // 3) for k in range(6)]  # 0 10 20 1 11 21
    assert [alike(Solve(6 + k, k + 3, 0), epochs) for k in range(3)] == [1, 11, 21]
    long = [Solve(k, k % 30, k) for k in range(60)]
    assert alike(Solve(61, 1, 0), [*long[:31], *long[31:59]]) == 31
    assert alike(Solve(45, 15, 0), [*long[:44], *long[46:]]) == 46
    assert expected([Solve(6, 3, 0), Solve(8, 5, 0)], epochs) == 22
