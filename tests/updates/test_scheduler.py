# SPDX-License-Identifier: MIT
"""Whose matrix goes next, and what a step adds to its object's sum: tables of pure functions."""

import dataclasses
import math
from typing import get_args

import numpy as np
import pytest

from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.rosenbrock import FORMS
from sim_server.scene.solver_options import Rule
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.scheduler import (
    UpdateRequests,
    is_worthwhile,
    max_factor_age,
    overdue_after,
    pick,
    round_duration,
)
from sim_server.updates.update_table import UpdateTable

NEW, BUSY = None, True
RULES = get_args(Rule)


@dataclasses.dataclass(frozen=True)
class Row:
    """What is known of one object, None where there is nothing yet."""

    object: str
    excess: float
    waited: int | None
    in_flight: bool
    age: int | None = None
    iteration_cost: float = 1.0
    factorization_cost: float = 1.0
    failures: int = 0
    lost: float = 0.0
    on_trial: bool = False
    latest: float = 0.0


def together(rows: list[Row]) -> UpdateRequests:
    """As arrays; an object's number is its place."""
    columns = ([getattr(r, f.name) for r in rows] for f in dataclasses.fields(UpdateRequests)[1:-1])
    kinds = (float, int, bool, int, float, float, int, float, bool, float)
    arrays = (
        np.array([-1 if value is None else value for value in column], kind)
        for column, kind in zip(columns, kinds, strict=True)
    )
    return UpdateRequests(np.arange(len(rows)), *arrays)


def picked(rows: list[Row], *arguments, **options) -> list[str]:
    return [rows[number].object for number in pick(together(rows), *arguments, **options)]


def requests(*rows: tuple) -> list[Row]:
    """Rows (object, excess, waited, in flight)."""
    return [Row(*row) for row in rows]


STEPS = [  # iterations, linearizations, form, estimate; excess above a floor of 3 with an error bound of 0.02 m
    (0, 1, "ONE_SOLVE", math.nan, 0),
    (3, 1, "ONE_SOLVE", math.nan, 0),
    (100, 1, "ONE_SOLVE", math.nan, 97),
    (9, 2, "ONE_SOLVE", math.nan, 3),
    (9, 1, "ITERATE", 1e-3, 3),
    (13, 1, "EULER", 5.0, 7),
    (0, 1, "FACTOR", 1e-3, 0.05),
    (0, 1, "FACTOR", 0.02, 1),
]


def steps() -> np.ndarray:
    rows = np.zeros(len(STEPS), RECORD)
    for row, (iterations, linearizations, form, estimate, _) in zip(rows, STEPS, strict=True):
        row["iterations"], row["linearizations"], row["form"] = iterations, linearizations, FORMS[form]
        row["estimate"], row["factor_step"] = estimate, -1
    return rows


def test_excess():
    """Of many steps together and of each alone."""
    expected = [row[-1] for row in STEPS]
    table = UpdateTable(len(STEPS))
    table.error_bound[:] = 0.02
    table.observe(steps().reshape(1, -1), 3)
    assert table.latest.tolist() == pytest.approx(expected)
    for record, value in zip(steps(), expected, strict=True):
        state = BodyUpdateState(None, error_bound=0.02)
        state.observe(record, 3, 1.0)
        assert state.solves.latest == pytest.approx(value)


# lost, cost of an iteration, of a factorization, age of the factor, threshold, on trial
WORTHWHILE = {
    "nothing lost": (0, 1, 9, 5, 1, False, False),
    "less than a factorization": (8, 1, 9, 5, 1, False, False),
    "as much": (9, 1, 9, 5, 1, False, True),
    "dear iterations": (3, 3, 9, 5, 1, False, True),
    "cheap iterations": (9, 0.5, 9, 5, 1, False, False),
    "a higher threshold": (9, 1, 9, 5, 2, False, False),
    "a lower one": (5, 1, 9, 5, 0.5, False, True),
    "threshold 0 is async": (0, 1, 9, 5, 0, False, True),
    "no factor yet": (0, 1, 9, None, 1, False, True),
    "to be tried out": (0, 1, 9, 5, 1, True, True),
}


@pytest.mark.parametrize("case", WORTHWHILE.values(), ids=WORTHWHILE.keys())
def test_is_worthwhile(case):
    lost, cost, service, age, threshold, trial, expected = case
    row = Row("a", 0, 7, False, age, cost, service, lost=lost, on_trial=trial)
    assert is_worthwhile(together([row]), threshold).tolist() == [expected]


def test_what_pays_makes_the_least_sum_of_lost_iterations_and_factorizations():
    """Iterations that grow by a each step: renewing when it pays against renewing each T steps, for every T."""
    grows, cost, service, steps = 0.7, 2.0, 150.0, 5000

    def total(renew) -> float:
        age, lost, spent = 0, 0.0, 0.0
        for _ in range(steps):
            age, lost = age + 1, lost + grows * age
            spent += grows * age * cost
            if renew(age, lost):
                age, lost, spent = 0, 0.0, spent + service
        return spent

    best = min(total(lambda age, lost, every=every: age >= every) for every in range(1, 200))
    found = total(
        lambda age, lost: is_worthwhile(together([Row("a", 0, age, False, age, cost, service, lost=lost)]))[0]
    )
    assert found < 1.02 * best


TABLE = {
    "nothing": ([], 1, 1, []),
    "one": ([("a", 0, 5, False)], 1, 1, ["a"]),
    "no place": ([("a", 9, 5, False)], 0, 1, []),
    "a negative number of places": ([("a", 9, 5, False)], -1, 1, []),
    "largest excess": ([("a", 1, 5, False), ("b", 3, 5, False), ("c", 2, 5, False)], 1, 1, ["b"]),
    "two places": ([("a", 1, 5, False), ("b", 3, 5, False), ("c", 2, 5, False)], 2, 1, ["b", "c"]),
    "more places than objects": ([("a", 1, 5, False), ("b", 3, 5, False)], 7, 1, ["b", "a"]),
    "without a factor first": ([("a", 99, 50, False), ("b", 0, NEW, False)], 2, 1, ["b", "a"]),
    "both without, by excess": ([("a", 1, NEW, False), ("b", 2, NEW, False)], 2, 1, ["b", "a"]),
    "in flight is left out": ([("a", 9, 5, BUSY), ("b", 1, 5, False)], 2, 1, ["b"]),
    "in flight without a factor": ([("a", 9, NEW, BUSY)], 1, 1, []),
    "floor of steps": ([("a", 9, 3, False), ("b", 1, 4, False)], 2, 4, ["b"]),
    "floor of steps does not hold back the first": ([("a", 0, NEW, False)], 1, 100, ["a"]),
    "equal excess, who waited longer": ([("a", 2, 5, False), ("b", 2, 9, False)], 1, 1, ["b"]),
    "all equal, in order": ([("a", 2, 5, False), ("b", 2, 5, False)], 2, 1, ["a", "b"]),
    "no excess at all, who waited longer": ([("a", 0, 1, False), ("b", 0, 30, False)], 1, 1, ["b"]),
}


@pytest.mark.parametrize(("rows", "places", "floor", "expected"), TABLE.values(), ids=TABLE.keys())
def test_pick(rows, places, floor, expected):
    assert picked(requests(*rows), places, floor) == expected


def test_everybody_gets_a_turn():
    """With equal needs a single place goes round: whoever was sent has waited least."""
    waited: dict[str, int | None] = dict.fromkeys("abc")
    order = []
    for _ in range(9):
        chosen = picked(requests(*((name, 1.0, w, False) for name, w in waited.items())), 1)[0]
        order.append(chosen)
        waited = {name: None if w is None else w + 1 for name, w in waited.items()}
        waited[chosen] = 1
    assert "".join(order) == "abcabcabc"


def test_the_busy_do_not_starve_the_calm():
    """The rule of the paper goes by excess alone; a calm object comes as soon as its sum is the largest."""
    sums, order = {"shaken": 0.0, "calm": 0.0}, []
    for _ in range(60):
        sums["shaken"] += 20
        sums["calm"] += 1
        chosen = picked(requests(*((name, s, 5, False) for name, s in sums.items())), 1)[0]
        sums[chosen] = 0
        order.append(chosen)
    assert order.count("calm") == 2


def request(object: str, **counters) -> Row:
    return Row(**({"object": object, "excess": 0.0, "waited": 10, "in_flight": False, "age": 12} | counters))


RULE_TABLE = {
    "round robin: sent longest ago": ("round_robin", [request("a", waited=5, excess=99), request("b", waited=9)], "ba"),
    "round robin: of equals the first": ("round_robin", [request("a"), request("b")], "ab"),
    "excess: the sum as it will be": ("excess", [request("a", excess=30), request("b", excess=15, latest=2.0)], "ba"),
    "excess: a larger sum all the same": (
        "excess",
        [request("a", excess=30), request("b", excess=5, latest=2.0)],
        "ab",
    ),
}


@pytest.mark.parametrize(("rule", "rows", "expected"), RULE_TABLE.values(), ids=RULE_TABLE.keys())
def test_rules(rule, rows, expected):
    assert "".join(picked(rows, 9, rule=rule)) == expected


def turns(costs: list[float], steps: int = 1200) -> np.ndarray:
    """Mean steps between two matrices of each object by excess, one of which goes in each step. costs: excess of each
    in a step"""
    excess, waited, times = np.zeros(len(costs)), np.zeros(len(costs), int), np.zeros(len(costs), int)
    for _ in range(steps):
        excess, waited = excess + costs, waited + 1
        rows = [Row(str(k), *row, False) for k, row in enumerate(zip(excess, waited.tolist(), strict=True))]
        chosen = int(picked(rows, 1)[0])
        excess[chosen], waited[chosen], times[chosen] = 0, 0, times[chosen] + 1
    return steps / times


def test_objects_that_always_differ_have_turns_that_differ_less():
    """One that iterates four times as much has two and a half times as many turns, not four times, and one that
    iterates a hundred times as much still comes first."""
    found = turns([1.0] * 6 + [4.0] * 6)
    ratio = found[:6].mean() / found[6:].mean()
    assert ratio == pytest.approx(4 ** (1 / 1.5), rel=0.1)
    shaken = turns([1.0] * 12 + [100.0])
    assert shaken[-1] < 0.1 * shaken[:-1].min()


@pytest.mark.parametrize("rule", RULES)
def test_whatever_the_rule(rule):
    """First those never sent, then the overdue, longest first; those in flight or just served are left out."""
    rows = [request("wild", excess=1e9, waited=3, age=1000), request("late", waited=40), request("later", waited=41),
            request("new", waited=None, age=None), request("busy", excess=1e9, waited=90, in_flight=True),
            request("just", excess=1e9, waited=1, age=2000)]  # fmt: skip
    assert picked(rows, 9, min_interval=2, rule=rule, overdue=40) == ["new", "later", "late", "wild"]
    assert picked(rows, 2, min_interval=2, rule=rule, overdue=40) == ["new", "later"]


@pytest.mark.parametrize(
    ("failures", "waited", "ready"),
    [(0, 3, True), (1, 5, False), (1, 6, True), (2, 11, False), (99, 3 * 2**10 - 1, False), (99, 3 * 2**10, True)],
)
def test_an_object_whose_jobs_fail_is_asked_less_and_less_often(failures, waited, ready):
    assert bool(picked([request("a", waited=waited, failures=failures)], 1, min_interval=3)) is ready


def test_bounds_of_the_age():
    assert round_duration(1 + 2 + 3, 2) == 3
    assert overdue_after(8, 1 + 2 + 3, 2) == 24
    assert max_factor_age(24, 1 + 2 + 3, 3, 2) == 24 + 3 + 2 * 3 + 2
    assert overdue_after(8, 1.0, 0) == math.inf  # nobody serves: nobody is overdue before another
    assert max_factor_age(math.inf, 1.0, 1.0, 0) == max_factor_age(8, 0, 0, 1) == -1


def oldest_seen(rule: Rule, services: list[int], wild: dict[int, float], workers: int, rounds: float) -> int:
    """Largest age of a factor in 3000 steps of a server with such objects, whose factors take so many steps each."""
    rows = [request(str(k), waited=0, age=0, factorization_cost=float(s)) for k, s in enumerate(services)]
    done: dict[int, int] = {}  # object: step at which its factor comes
    seen, overdue = 0, overdue_after(rounds, sum(services), workers)
    for step in range(3000):
        for k in [k for k, at in done.items() if at <= step]:
            rows[k] = dataclasses.replace(rows[k], in_flight=False, age=rows[k].waited)
            del done[k]
        seen = max(seen, *(row.age or 0 for row in rows))
        for name in picked(rows, workers - len(done), rule=rule, overdue=overdue):
            k = int(name)
            done[k] = step + services[k]
            rows[k] = dataclasses.replace(rows[k], in_flight=True, waited=0, excess=0.0)
        rows = [dataclasses.replace(row, waited=(row.waited or 0) + 1, age=(row.age or 0) + 1,
                                    excess=row.excess + wild.get(k, 0)) for k, row in enumerate(rows)]  # fmt: skip
    return seen


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("rounds", [1, 4])
@pytest.mark.parametrize("rule", RULES)
def test_nobody_starves(rule, rounds, workers):
    """Three of twelve need all that the workers can do; the others are served within the bound all the same."""
    services = [1, 2, 5, 9] * 3
    bound = max_factor_age(overdue_after(rounds, sum(services), workers), sum(services), max(services), workers)
    seen = oldest_seen(rule, services, {0: 50.0, 5: 80.0, 6: 100.0}, workers, rounds)
    assert 0 < seen <= bound


def test_without_a_bound_the_calm_would_starve():
    """What test_nobody_starves guards against does happen otherwise."""
    assert oldest_seen("excess", [1, 2, 5], {0: 50.0, 1: 80.0}, 1, math.inf) > 2900


@pytest.mark.parametrize("places", [1, 7, 64])
@pytest.mark.parametrize("spread", [0, 5])
@pytest.mark.parametrize("rule", RULES)
def test_of_equal_needs_the_oldest_goes_first(rule, spread, places):
    """Many bodies that lose the same, in any order and with factors that take one to 1 + spread steps: none waits
    longer than the workers need for all of the others, and then as long as a factor takes."""
    bodies, rng = 100, np.random.default_rng(places + spread)
    sent, newest, comes = np.full(bodies, -1), np.full(bodies, -1), np.full(bodies, -1)
    order, oldest = rng.permutation(bodies), 0
    for step in range(600):
        came = comes == step
        newest[came], comes[came] = sent[came], -1
        flying, excess = comes >= 0, np.ones(bodies)
        rows = UpdateRequests(
            np.arange(bodies), excess, np.where(sent >= 0, step - sent, -1), flying, step - newest, excess, excess,
            np.zeros(bodies, int), excess, np.zeros(bodies, bool), excess,
        ).of(order)  # fmt: skip
        chosen = pick(rows, places - int(flying.sum()), rule=rule)
        sent[chosen] = step
        comes[chosen] = step + 1 + rng.integers(0, spread + 1, len(chosen))
        if step >= 300:
            oldest = max(oldest, int((step - newest).max()))
    longest = 1 + spread
    assert oldest <= math.ceil(bodies / places) * longest + 2 * longest


def ranked(q: UpdateRequests, places: int, min_interval: int, rule: Rule, overdue: float) -> list[int]:
    """The rule of `pick` by sorting whole columns."""
    new = q.waited < 0
    rested = new | (q.waited >= min_interval << np.minimum(q.failures, 10))
    ready = q.of(np.flatnonzero(rested & ~q.in_flight))
    new, late = ready.waited < 0, ready.waited >= overdue
    summed = (ready.excess + 10.0 * ready.latest) * np.sqrt(np.maximum(ready.waited, 1))
    need = summed if rule == "excess" else ready.waited
    first = np.where(new, ready.excess, np.where(late, ready.waited, need))
    group = np.where(new, 0, np.where(late, 1, 2))
    order = np.lexsort((np.where(new, 0, -ready.waited), -first, group))
    return ready.body[order[:places]].tolist()


def random_requests(rng: np.random.Generator, bodies: int, fractions: bool) -> UpdateRequests:
    """With many equal ones, or with sums whose last digits decide; of some the sums are infinite or no number."""
    sums, latest = rng.integers(0, 5, (2, bodies)).astype(float)
    if fractions:
        sums, latest = 0.1 * sums + rng.uniform(0, 1e-15, bodies), 0.01 * latest
        sums[rng.random(bodies) < 0.05], sums[rng.random(bodies) < 0.05] = np.nan, np.inf
    flags = rng.random((2, bodies)) < 0.3
    return UpdateRequests(
        rng.permutation(3 * bodies)[:bodies], sums, rng.integers(-1, 20, bodies), flags[0], rng.integers(-1, 9, bodies),
        np.ones(bodies), np.ones(bodies), rng.integers(0, 4, bodies) * (rng.random(bodies) < 0.2), sums, flags[1],
        latest,
    )  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("fractions", [False, True])
def test_the_most_urgent_are_those_that_come_first_when_all_are_sorted(rule, fractions):
    rng = np.random.default_rng(0)
    for bodies in (1, 2, 7, 100, 1500):
        for overdue in (math.inf, 7.5, 0.0):
            q = random_requests(rng, bodies, fractions)
            for places in (0, 1, bodies // 3, bodies, bodies + 5):
                for interval in (1, 3):
                    found = pick(q, places, interval, rule, overdue)
                    assert found == ranked(q, places, interval, rule, overdue)
