# SPDX-License-Identifier: MIT
"""Factors of one message: checked and used together, each as if it had come alone."""

from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from protocol.factor import Factor
from protocol.method import Method
from protocol.shared_memory.copies import Parts
from protocol.shared_memory.located import addresses
from sim_server.backends.factors_together import FactorsTogether
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_check import FactorCheck
from sim_server.updates.factor_source import FactorSource, Job
from sim_server.updates.many_factors import MANY
from sim_server.updates.take_in import BegunCheck, take_in
from sim_server.updates.update_table import NONE
from tests.scenes import bar, simulation

BODIES = MANY + 3


class Messages(FactorSource):
    """A source whose factors the test gives, alone or together. It takes no jobs."""

    def __init__(self) -> None:
        self.alone: list[Factor] = []
        self.together: list[FactorsTogether] = []
        self.over: set[str] = set()  # objects that were split since
        self.blamed: list[str] = []
        self.begin_check: Callable[..., Any] = lambda *jobs: None

    def ready(self) -> int:
        return 0

    def submit(self, job: Job) -> bool:
        return False

    def poll(self) -> list[Factor]:
        found, self.alone = self.alone, []
        return found

    def poll_together(self) -> list[FactorsTogether]:
        found, self.together = self.together, []
        return found

    def failures(self) -> list[tuple[str, str]]:
        return []

    def epoch(self, name: str) -> int | None:
        return 2 if name in self.over else 1

    def check_with(self, begin: Callable[..., Any]) -> None:
        self.begin_check = begin

    def factor_failed(self, worker: str, object: str, pattern: int | None = None) -> None:
        self.blamed.append(object)


def falling() -> Simulation:
    bars = [bar((2, 1, 1), young=1e6 * (1 + 0.1 * k), fixed="X < 0.01", name=f"bar{k}") for k in range(BODIES)]
    return simulation(*bars, gravity=(0, -9.81, 0), preconditioner="cholesky", update="async")


def start() -> tuple[Driver, Messages]:
    """A driver at step 3, of all of whose bodies a job is in flight."""
    sim = falling()
    driver = Driver(sim, source := Messages())
    sim.engine.run(3)
    for state in driver.bodies:
        in_flight(driver, state.body.index)
    return driver, source


def in_flight(driver: Driver, body: int) -> None:
    """As if the matrix of this step had been sent."""
    state, step, b = driver.bodies[body], driver.engine.step, driver.simulation.world.bodies[body]
    driver.engine.assemble()
    values = np.array(driver.simulation.system.body_values(b.first, b.last))
    driver.engine.solve()
    state.on_job(step, Method())
    state.job.set_copy(values)
    state.on_sent(step)


def made(driver: Driver) -> FactorsTogether:
    """Factors of the matrices in flight, of one message."""
    found = []
    for state in driver.bodies:
        step, values = state.job.matrix
        driver.inline.submit(Job(state.body.name, 1, step, True, values, "float32"))
        found += driver.inline.poll()
    first = found[0].pattern
    assert all(each.pattern.id == first.id for each in found)
    return FactorsTogether(
        first, "w", "cholesky", [f.object for f in found], [1] * BODIES, [f.step for f in found], [True] * BODIES,
        [f.values for f in found], [1e-4 * (k + 1) for k in range(BODIES)], [""] * BODIES,
    )  # fmt: skip


def checked(driver: Driver) -> None:
    """Takes up what has come until nothing is checked any more."""
    driver.receive(driver.source, driver.policy.on_factors)
    while driver.checks:
        wait([each.reasons for each in driver.checks])
        driver.receive(driver.source, driver.policy.on_factors)


def begun(driver: Driver, factors: FactorsTogether) -> BegunCheck | None:
    """What they would be checked with as they come."""
    return driver.source.begin_check(factors.objects, factors.epochs, [factors.pattern] * len(factors))


def checked_as_they_come(driver: Driver, factors: FactorsTogether) -> FactorsTogether:
    """As the thread that copies them does."""
    check = begun(driver, factors)
    matrices = [driver.by_name[name].job.matrix[1] for name in factors.objects]
    slot, size = np.concatenate(factors.values), factors.values[0].nbytes
    source = Parts(slot, size * np.arange(len(factors)))
    taken = take_in(source, [factors.pattern] * len(factors), np.empty_like(slot), check, addresses(matrices))
    came = replace(factors, values=taken.values)
    check.end(came, taken)
    return came


def told(driver: Driver) -> list[tuple[Any, ...]]:
    """What is known of each body."""
    return [
        (t.factors.newest, t.factors.used, t.factors.regularized, t.factors.cost.value, t.factors.workers,
         t.job.in_flight, t.job.checked, t.job.sent, t.job.matrix is None, t.failures.in_a_row, t.failures.refused,
         t.failures.reason)
        for t in driver.bodies
    ]  # fmt: skip


def spoilt(factors: FactorsTogether, places: list[int]) -> FactorsTogether:
    """Some of them are nan; another one is of a matrix that had to be changed."""
    values = [np.full_like(v, np.nan) if k in places else v for k, v in enumerate(factors.values)]
    return replace(factors, values=values, remedies=["shifted" if k == 1 else "" for k in range(BODIES)])


@pytest.mark.parametrize("early", [False, True], ids=["checked beside", "checked as they come"])
@pytest.mark.parametrize("bad", [[], [0], [2, 5, BODIES - 1], list(range(BODIES))], ids=str)
def test_together_they_are_used_or_refused_as_if_each_came_alone(bad, early):
    (one, alone), (many, together) = start(), start()
    alone.alone = list(spoilt(made(one), bad))
    factors = spoilt(made(many), bad)
    together.together = [checked_as_they_come(many, factors) if early else factors]
    checked(one), checked(many)
    assert told(one) == told(many) and alone.blamed == together.blamed == [f"bar{k}" for k in bad]
    steps = [one.engine.run(1) and one.engine.records()["factor_step"].tolist()[-BODIES:] for _ in range(2)]
    assert steps == [many.engine.run(1) and many.engine.records()["factor_step"].tolist()[-BODIES:] for _ in range(2)]
    assert steps[-1] == [-1 if k in bad else many.bodies[k].factors.newest for k in range(BODIES)]
    np.testing.assert_array_equal(one.simulation.world.x, many.simulation.world.x)


def test_they_are_checked_together_and_the_next_matrices_may_leave_meanwhile():
    driver, source = start()
    source.together = [factors := made(driver)]
    driver.receive(source, driver.policy.on_factors)
    (check,) = driver.checks
    assert check.factors is factors
    assert not driver.table.in_flight.any() and (driver.table.checked == driver.table.sent).all()
    checked(driver)
    assert (driver.table.checked == NONE).all() and (driver.table.used == 1).all()


def test_those_that_wait_for_a_check_and_those_of_bodies_that_move_no_more_are_taken_one_by_one():
    driver, source = start()
    first = made(driver)
    source.together = [first]
    driver.receive(source, driver.policy.on_factors)
    driver.bodies[1].frozen = True
    checked(driver)
    for body in range(BODIES):
        in_flight(driver, body)
    second = made(driver)
    driver.table.checked[0] = 7  # as if one of step 7 were checked
    driver.bodies[2].factors.newest = second.steps[2] + 1
    source.together = [second]
    driver.receive(source, driver.policy.on_factors)
    (check,) = driver.checks
    assert list(check.factors.objects) == [f"bar{k}" for k in range(3, BODIES)]
    wait([check.reasons])
    driver.table.checked[0] = NONE
    checked(driver)
    assert [t.factors.newest for t in driver.bodies[:4]] == [*second.steps[:2], second.steps[2] + 1, second.steps[3]]
    assert [t.factors.used for t in driver.bodies[:4]] == [2, 2, 1, 2]


def test_those_that_were_checked_as_they_came_are_used_at_once_however_few():
    driver, source = start()
    memory = driver.bodies[0].job.matrix[1]
    source.together = [checked_as_they_come(driver, made(driver).of([0, 3]))]
    driver.receive(source, driver.policy.on_factors)
    assert not driver.checks and driver.table.used[:4].tolist() == [1, 0, 0, 1]
    assert driver.bodies[0].job.matrix is None and any(memory is each for each in driver.snapshots.free[memory.shape])


def test_those_that_are_good_are_made_ready_where_they_are_checked_and_dropped_if_they_are_not_used(monkeypatch):
    driver, source = start()
    prepared: list[tuple[int, int]] = []
    dropped: list[tuple[int, int]] = []
    monkeypatch.setattr(
        driver.engine, "prepare_together", lambda bodies, own: prepared.extend(zip(bodies, own.steps, strict=True))
    )
    monkeypatch.setattr(driver.engine, "drop_factor", lambda body, factor: dropped.append((body, factor.step)))
    source.together = [factors := checked_as_they_come(driver, spoilt(made(driver), [2]))]
    own = list(enumerate(factors.steps))
    assert prepared == [each for each in own if each[0] != 2]
    source.over = {"bar5"}
    checked(driver)
    assert sorted(dropped) == [own[2], own[5]] and driver.table.used.tolist() == [
        int(k not in (2, 5)) for k in range(BODIES)
    ]
    for body in range(BODIES):
        in_flight(driver, body)
    dropped.clear()
    later = made(driver)
    monkeypatch.setattr(driver.table, "on_factors", lambda bodies, *_: [body != 7 for body in bodies.tolist()])
    source.over, source.together = set(), [checked_as_they_come(driver, later)]
    checked(driver)
    assert dropped == [(7, later.steps[7])]


def test_what_comes_while_others_are_adopted_is_adopted_later_as_it_came(monkeypatch):
    """It would be checked once more, one by one: `poll` returns factors of messages, too."""
    driver, source = start()
    first = checked_as_they_come(driver, made(driver).of(range(2)))
    later = checked_as_they_come(driver, made(driver).of(range(2, BODIES)))
    adopt, alone = driver._many.adopt, []

    def slow(factors: FactorsTogether) -> None:
        adopt(factors)
        if factors is first:
            source.together.append(later)

    monkeypatch.setattr(driver._many, "adopt", slow)
    monkeypatch.setattr(source, "poll", lambda: [each for factors in source.poll_together() for each in factors])
    source.together = [first]
    driver.receive(source, alone.extend)
    driver.receive(source, alone.extend)
    assert alone == [] and (driver.table.used == 1).all()


def test_a_verdict_on_a_matrix_that_is_not_there_any_more_counts_for_nothing(monkeypatch):
    """Its memory may have been written to while it was checked: each of them is checked again, without it."""
    driver, source = start()
    factors = checked_as_they_come(driver, made(driver))
    factors.reasons[4] = "spoilt meanwhile"
    driver.snapshots.release(driver.bodies[4])
    seen, check = [], driver.check.reject_reasons
    monkeypatch.setattr(driver.check, "reject_reasons", lambda given, *more: seen.append(given) or check(given, *more))
    source.together = [factors]
    checked(driver)
    assert (driver.table.used == 1).all() and source.blamed == []
    assert [(factor.object, matrix) for given in seen for factor, matrix in given] == [("bar4", None)]


def test_those_that_are_not_of_the_size_of_their_object_are_checked_later():
    driver, _ = start()
    factors, sim = made(driver), driver.simulation
    driver.check = FactorCheck(
        {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies[1:]}
        | {"bar0": sim.system.body_pattern(0, sim.world.bodies[1].last)}
    )
    assert begun(driver, factors) is None and begun(driver, factors.of([1, 2])) is not None


def test_few_are_taken_one_by_one():
    driver, source = start()
    source.together = [made(driver).of(range(MANY - 1))]
    driver.receive(source, driver.policy.on_factors)
    assert not driver.checks and driver.table.used.tolist() == [1] * (MANY - 1) + [0] * (BODIES - MANY + 1)


def test_a_factor_of_a_mesh_that_was_split_meanwhile_costs_the_others_nothing():
    driver, source = start()
    source.together = [made(driver)]
    driver.receive(source, driver.policy.on_factors)
    source.over = {"bar4"}
    checked(driver)
    assert [t.factors.used for t in driver.bodies] == [int(k != 4) for k in range(BODIES)]
    assert "split since" in driver.bodies[4].failures.reason and source.blamed == []


def test_a_check_that_fails_by_itself_refuses_all_of_them_and_blames_nobody(monkeypatch):
    driver, source = start()
    monkeypatch.setattr(driver.check, "reject_together", lambda *_: {}["nose"])
    source.together = [made(driver)]
    checked(driver)
    assert (driver.table.used == 0).all() and source.blamed == []
    assert driver.counters.refusals == {"unexpected": 1}
    assert all("its check failed: KeyError" in t.failures.reason for t in driver.bodies)


def test_of_one_that_is_older_than_that_which_came_meanwhile_nothing_is_left():
    driver, source = start()
    source.together = [factors := made(driver)]
    driver.receive(source, driver.policy.on_factors)
    driver.bodies[3].factors.newest = factors.steps[3] + 1
    checked(driver)
    assert [t.factors.used for t in driver.bodies] == [int(k != 3) for k in range(BODIES)]
    driver.engine.run(1)
    assert driver.engine.records()["factor_step"].tolist()[-BODIES:][2:5] == [factors.steps[2], -1, factors.steps[4]]


def test_each_of_them_is_judged_as_if_it_came_alone():
    """To the bit; also those that are not of the size of their object."""
    driver, _ = start()
    factors = spoilt(made(driver), [1, 6])
    matrices = [state.job.matrix[1] for state in driver.bodies]
    matrices[2] = None
    sim = driver.simulation
    patterns = {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies}
    check = FactorCheck(patterns)
    alone = [check.reject_reasons([each])[0] for each in zip(factors, matrices, strict=True)]
    assert check.reject_together(factors, matrices) == alone and [bool(a) for a in alone].count(True) == 2
    larger = FactorCheck(patterns | {"bar3": sim.system.body_pattern(0, sim.world.bodies[1].last)})
    told = larger.reject_together(factors, matrices)
    assert told[3].startswith("its size is") and told[:3] + told[4:] == alone[:3] + alone[4:]


def test_observers_are_told_of_each():
    driver, source = start()
    seen: list[Factor] = []
    driver.on_adopt.append(seen.append)
    source.together = [factors := spoilt(made(driver), [2])]
    checked(driver)
    assert [each.object for each in seen] == [name for name in factors.objects if name != "bar2"]
    assert all(each.method == "cholesky" and each.worker == "w" for each in seen)
    assert [each.seconds for each in seen[:2]] == factors.seconds[:2] and seen[1].remedy == "shifted"


def test_columns_are_a_sequence_of_factors():
    driver, _ = start()
    factors = made(driver)
    assert len(factors) == BODIES and [f.object for f in factors] == factors.objects
    assert isinstance(factors[2], Factor) and factors[2].values is factors.values[2]
    assert factors[1:3].objects == factors.objects[1:3] == factors.of([1, 2]).objects
    assert factors[-1].seconds == factors.seconds[-1]
    with pytest.raises(IndexError):
        factors[BODIES]
