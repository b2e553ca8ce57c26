# SPDX-License-Identifier: MIT
"""The tuner that chooses among arms: when trials are due, who takes over, and what is remembered of costs."""

from dataclasses import dataclass

import pytest

from sim_server.updates.autotune.tuner import MARGIN, MAX_TRIAL_INTERVAL, TRIAL_INTERVAL, Tuner


@dataclass
class Price:
    cost: float = 1.0

    def beats(self, other: "Price") -> bool:
        return self.cost * MARGIN < other.cost


def tuner(arms: str = "abc", **options: int) -> Tuner[str, Price]:
    return Tuner(arms, Price, **options)


def trial(t: Tuner[str, Price], arm: str, cost: float) -> bool:
    """A whole trial of an arm."""
    t.candidate, t.costs[arm] = arm, Price(cost)
    assert t.active == arm and not t.is_due()
    return t.end_trial()


@pytest.mark.parametrize(("cost", "gained"), [(0.5, True), (0.95, False), (1.0, False), (2.0, False)])
def test_an_arm_takes_over_if_it_costs_less_by_a_margin(cost: float, gained: bool) -> None:
    t = tuner()
    assert trial(t, "b", cost) is gained
    assert t.active == t.current == ("b" if gained else "a") and t.candidate is None
    assert t.costs["b"].cost == cost, "what the trial found is kept"


def test_trials_without_gain_become_rare_and_one_with_gain_makes_them_frequent_again() -> None:
    t, waits = tuner(settle=7, first=3), []
    for _ in range(8):
        waits.append(t.wait)
        t.solves = t.wait - 1
        assert not t.is_due()
        t.solves += 1
        assert t.is_due()
        trial(t, "b", 2.0)
        assert t.solves == 0
    doubled = [TRIAL_INTERVAL * 2**k for k in range(1, 8)]
    assert waits == [3, *(min(wait, MAX_TRIAL_INTERVAL) for wait in doubled)]
    assert trial(t, "b", 0.5) and t.wait == 7
    trial(t, "c", 2.0)
    assert t.wait == 2 * TRIAL_INTERVAL


def test_an_arm_taken_into_use_without_a_trial_has_no_known_cost() -> None:
    t = tuner()
    t.costs["a"].cost = t.costs["b"].cost = 9.0
    t.candidate = "c"
    t.use("b")
    assert (t.current, t.active, t.costs["b"].cost) == ("b", "b", Price().cost)
    t.costs["b"].cost = 5.0
    t.use("b")
    assert t.costs["b"].cost == 5.0, "it was in use already"


def test_arms_follow_one_another() -> None:
    assert [tuner().following(arm) for arm in "abc"] == ["b", "c", "a"]
    assert tuner("a").following("a") == "a"
