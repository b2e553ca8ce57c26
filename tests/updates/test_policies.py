# SPDX-License-Identifier: MIT
"""Update policies: which step is solved with the factor of which, and that nothing stops the run.

Record k (from 0) is of the step made from state k; factor_step says which state's matrix the factor came from (-1: no
factor).
"""

import logging
import threading
import time
from concurrent.futures import wait
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from sim_server.updates import driver as driver_module
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.policies.free_running import MAX_REQUESTS, Adaptive
from sim_server.updates.stats import flops
from sim_server.updates.update_table import NONE
from tests.scenes import bar, factor_of, simulation
from tests.solver.solves import applied
from tests.support.virtual_workers import VirtualWorkers


def falling(*bodies: dict, **solver) -> Simulation:
    """A beam (or several) under gravity, with the factor as preconditioner."""
    beams = bodies or (bar((4, 2, 2), young=1e6, fixed="X < 0.01"),)
    return simulation(
        *beams, gravity=(0, -9.81, 0), **({"preconditioner": "cholesky", "max_iterations": 2000} | solver)
    )


def factor_steps(update: str, steps: int, **solver) -> list[int]:
    return Driver(falling(update=update, **solver)).advance(steps)["factor_step"].tolist()


def test_never_is_one_factor_of_the_first_matrix():
    assert factor_steps("never", 8) == [0] * 8


@pytest.mark.parametrize("n", [1, 3, 5])
def test_every_n_is_a_new_one_each_nth_step_which_waits_for_it(n):
    assert factor_steps(f"every-{n}", 12) == [n * (k // n) for k in range(12)]


@pytest.mark.parametrize(("update", "made_at"), [("never", [0]), ("every-3", [0, 3])])
def test_the_step_time_holds_the_factorization_that_the_step_waited_for(update, made_at, monkeypatch):
    driver, clocks = Driver(falling(update=update)), []
    submit = driver.inline.submit

    def timed(job: Job) -> bool:
        begin = time.perf_counter()
        done = submit(job)
        clocks.append(time.perf_counter() - begin)
        return done

    monkeypatch.setattr(driver.inline, "submit", timed)
    records = driver.advance(5)
    assert len(clocks) == len(made_at)
    for step, spent in zip(made_at, clocks, strict=True):
        r = records[step]
        assert r["whole"] >= spent + r["assemble"] + r["solve"] + r["integrate"]


@pytest.mark.parametrize("delay", [1, 3, 5])
def test_lockstep_takes_up_the_factor_of_step_t_at_t_plus_d(delay):
    """A new matrix goes out when the last factor came in, so a factor serves from t + D to t + 2 D."""
    expected = [-1] * delay + [delay * (k // delay - 1) for k in range(delay, 4 * delay + 2)]
    assert factor_steps(f"lockstep-{delay}", len(expected)) == expected


def test_async_without_workers_factorizes_in_this_process_between_steps():
    steps = factor_steps("async", 12)
    assert steps[:2] == [-1, -1]
    assert steps[2] == 0
    ages = [k - made for k, made in enumerate(steps) if made >= 0]
    assert max(ages) <= 4
    assert steps == sorted(steps)


@pytest.mark.parametrize("preconditioner", ["none", "jacobi", "block_jacobi"])
@pytest.mark.parametrize("update", ["never", "every-1", "lockstep-2", "async", "adaptive"])
def test_without_use_for_factors_none_is_made(preconditioner, update, monkeypatch):
    def refuse(*_):
        raise AssertionError("factorized")

    monkeypatch.setattr(Inline, "submit", refuse)
    records = Driver(falling(preconditioner=preconditioner, update=update)).advance(4)
    assert (records["factor_step"] == -1).all()
    assert (records["kind"] == Kind[preconditioner.upper()]).all()


@pytest.mark.parametrize("update", ["lockstep-3", "every-4", "never"])
def test_a_run_repeats_bit_for_bit(update):
    runs = []
    for _ in range(2):
        sim = falling(update=update)
        records = Driver(sim).advance(30)
        runs.append((sim.world.x.tobytes(), sim.world.v.tobytes(), records["iterations"].tolist()))
    assert runs[0] == runs[1]


def test_advance_in_parts_is_the_same_as_at_once():
    whole, parts = falling(update="lockstep-3"), falling(update="lockstep-3")
    Driver(whole).advance(20)
    driver = Driver(parts)
    for count in (1, 0, 7, 2, 10):
        assert len(driver.advance(count)) == count
    assert np.array_equal(whole.world.x, parts.world.x)


def test_several_bodies_have_factors_of_their_own():
    bodies = [bar((4, 2, 2), name=f"beam{i}", young=1e5 * 4**i, fixed="X < 0.01") for i in range(3)]
    for update in ("every-4", "lockstep-3"):
        together = falling(*bodies, update=update)
        records = Driver(together).advance(20)
        for body, table in zip(together.world.bodies, bodies, strict=True):
            alone = falling(table, update=update)
            own = records[records["body"] == body.index]
            theirs = Driver(alone).advance(20)
            for field in ("factor_step", "iterations", "kind", "step"):
                assert np.array_equal(own[field], theirs[field])
            assert np.array_equal(together.world.x[body.nodes], alone.world.x)


def test_async_serves_every_body_in_turn():
    bodies = [bar(name=f"beam{i}", young=1e5 * 4**i, fixed="X < 0.01") for i in range(3)]
    driver = Driver(falling(*bodies, update="async"))
    driver.advance(60)
    used = [t.factors.used for t in driver.bodies]
    assert min(used) >= 3
    assert all(t.factors.newest > 20 for t in driver.bodies)


class Failing(Inline):
    """Refuses to factorize the matrices of some steps."""

    def __init__(self, patterns, bad):
        super().__init__(patterns)
        self.bad, self.refused = bad, []

    def submit(self, job: Job) -> bool:
        if job.step in self.bad:
            self.refused.append((job.object, "matrix: not positive definite (as the test wants it)"))
            return True
        return super().submit(job)

    def failures(self) -> list[tuple[str, str]]:
        refused, self.refused = self.refused, []
        return refused + super().failures()


def patterns_of(sim: Simulation) -> dict:
    return {b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies}


def test_the_shaken_one_of_four_is_served_most():
    """Each gets its first factor; from then on the sum of excess iterations decides."""
    sim = falling(*(bar((4, 2, 2), name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(4)), update="async")
    driver, shaken, rng = Driver(sim), sim.world.bodies[2], np.random.default_rng(0)
    for _ in range(60):
        sim.world.v[shaken.nodes] += rng.normal(size=(shaken.last - shaken.first, 3))
        driver.advance(1)
    used = [t.factors.used for t in driver.bodies]
    calm = used[:2] + used[3:]
    assert min(calm) >= 1
    assert used[2] > 2 * max(calm)


class Idle(Inline):
    """So many idle workers, whose factors never come; what each of them was sent."""

    def __init__(self, patterns, idle: int):
        super().__init__(patterns)
        self.idle, self.sent = idle, []

    def ready(self) -> int:
        return self.idle - len(self.sent)

    def worker_count(self) -> int:
        return self.idle

    def submit(self, job: Job) -> bool:
        if self.ready() <= 0:
            return False
        self.sent.append((job.object, job.step))
        return True


class Building(Idle):
    """One idle worker that builds matrices; what it was sent fails."""

    def assembles_matrices(self) -> bool:
        return True

    def submit(self, job: Job) -> bool:
        self.sent.append((job.positions, job.values.copy()))
        return True

    def failures(self) -> list[tuple[str, str]]:
        failed, self.sent_all = [("bar", "broken")] * len(self.sent), [*getattr(self, "sent_all", []), *self.sent]
        self.sent = []
        return failed


def test_positions_go_out_to_who_builds_and_the_matrix_after_three_failures(caplog):
    sim = falling(update="async", build="worker")
    driver = Driver(sim, source := Building(patterns_of(sim), 1))
    driver.advance(60)
    kinds = [positions for positions, _ in source.sent_all]
    assert kinds[:3] == [True] * 3 and not any(kinds[3:]) and len(kinds) > 3


@pytest.mark.parametrize(("extrapolate", "steps"), [(0.0, 0), (0.03, 1.5), (9.0, 3)])
def test_positions_are_those_expected_when_the_factor_comes(extrapolate, steps):
    sim = falling(update="lockstep-3", build="worker", extrapolate=extrapolate)
    driver = Driver(sim, source := Building(patterns_of(sim), 1))
    sim.engine.run(4)
    expected = sim.world.x + steps * sim.world.dt * sim.world.v
    driver.advance(1)
    (positions, x), *_ = source.sent
    assert positions
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("idle", [0, 1, 3, 5, 9])
def test_all_idle_workers_get_a_matrix_of_the_same_step(idle):
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(6)), update="async")
    source = Idle(patterns_of(sim), idle)
    driver = Driver(sim, source)
    driver.advance(2)
    assert source.sent == [(f"beam{k}", 0) for k in range(min(idle, 6))]
    driver.advance(5)
    assert len(source.sent) == min(idle, 6)  # one of an object at a time


def test_of_many_idle_workers_some_are_served_in_each_step():
    """The loop is not asked to copy everything at once."""
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(MAX_REQUESTS + 3)), update="async")
    source = Idle(patterns_of(sim), 100)
    Driver(sim, source).advance(4)
    steps = [step for _, step in source.sent]
    assert [steps.count(k) for k in range(2)] == [MAX_REQUESTS, 3]


def test_matrices_are_copied_into_the_same_memory_again():
    """So that the loop meets no page that was not touched before."""

    class Watched(Inline):
        def submit(self, job: Job) -> bool:
            places.append(job.values.ctypes.data)
            return super().submit(job)

    places: list[int] = []
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(3)), update="async")
    Driver(sim, Watched(patterns_of(sim))).advance(12)
    assert len(places) > 9 and len(set(places)) <= 2


@pytest.mark.parametrize("rule", ["round_robin", "excess"])
def test_the_scene_names_the_rule(rule):
    """A shaken object beside three calm ones: only the rule that looks at excess serves it more."""
    sim = falling(
        *(bar((4, 2, 2), name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(4)), update="async", schedule=rule
    )
    driver, shaken, rng = Driver(sim, counted=True), sim.world.bodies[2], np.random.default_rng(0)
    for _ in range(60):
        sim.world.v[shaken.nodes] += rng.normal(size=(shaken.last - shaken.first, 3))
        driver.advance(1)
    used = [t.factors.used for t in driver.bodies]
    if rule == "excess":
        assert used[2] > 2 * max(used[:2] + used[3:])
    else:
        assert max(used) - min(used) <= 1


@pytest.mark.parametrize("rounds", [1.0, 2.0, 3.0])
def test_ages_stay_within_the_bound_that_is_told(rounds):
    bodies = [bar((4, 2, 2), name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(5)]
    sim = falling(*bodies, update="async", schedule_rounds=rounds, update_floor_iterations=6)
    driver, shaken, rng = Driver(sim, counted=True), sim.world.bodies[1:4], np.random.default_rng(0)
    for _ in range(80):
        for body in shaken:
            sim.world.v[body.nodes] += rng.normal(size=(body.last - body.first, 3))
        driver.advance(1)
    bound = driver.age_bound()
    ages = [t.solves.max_factor_age for t in driver.bodies]
    assert max(ages) <= bound < 100
    assert max(ages) >= 10 * rounds > min(ages) > 0  # the calm wait until they are overdue


@pytest.mark.parametrize(("update", "bound"), [("never", -1), ("every-4", 3), ("lockstep-3", 5), ("async", -1)])
def test_bound_of_the_age_by_policy(update, bound):
    driver = Driver(falling(update=update))
    assert driver.age_bound() == bound
    records = driver.advance(14)
    assert driver.bodies[0].solves.max_factor_age == (records["step"] - 1 - records["factor_step"])[3:].max()
    assert update == "never" or driver.bodies[0].solves.max_factor_age <= driver.age_bound()


class Fluctuating(Inline):
    """A worker that is there every second time that somebody asks."""

    asked = 0

    def worker_count(self) -> int:
        self.asked += 1
        return self.asked % 2


@pytest.mark.parametrize("asked", [0, 1])
def test_a_worker_that_joins_or_leaves_while_the_bound_is_reckoned_changes_nothing(asked):
    sim = falling(update="async")
    driver = Driver(sim, source := Fluctuating(patterns_of(sim)))
    driver.advance(8)
    assert np.isfinite(driver.table.latency).all()
    source.asked = asked
    bound = driver.age_bound()
    assert bound > 0 if asked == 0 else bound == -1


def adaptive(gravity: float, steps: int, **solver) -> tuple[Driver, NDArray]:
    """A beam, one worker in virtual time: costs in bytes and operations."""
    beam = bar((6, 3, 3), (4, 1, 1), young=2e5, fixed="X < 0.01")
    table = {"preconditioner": "cholesky", "max_iterations": 2000} | solver
    driver = simulation_driver(simulation(beam, gravity=(0, gravity, 0), **table))
    return driver, driver.advance(steps)


def simulation_driver(sim: Simulation) -> Driver:
    return Driver(sim, VirtualWorkers(sim, 1, 2e6), counted=True)


def test_adaptive_keeps_the_factor_of_a_body_at_rest():
    driver, records = adaptive(-1e-6, 60, update="adaptive")
    assert driver.bodies[0].factors.used == 1
    assert (records["factor_step"][10:] == 0).all()
    assert driver.age_bound() == -1


def test_adaptive_makes_few_factors_for_a_body_in_motion_at_little_cost():
    """Fewer than async, with fewer iterations than never."""
    driver, records = adaptive(-2.0, 150, update="adaptive", warp=False)
    eager, often = adaptive(-2.0, 150, update="async", warp=False)
    _, once = adaptive(-2.0, 150, update="never", warp=False)
    assert 2 <= driver.bodies[0].factors.used < 0.7 * eager.bodies[0].factors.used
    assert often["iterations"].sum() <= records["iterations"].sum() < 0.7 * once["iterations"].sum()


def test_adaptive_with_threshold_0_is_async():
    one, records = adaptive(-2.0, 40, update="adaptive", update_threshold=0)
    other, same = adaptive(-2.0, 40, update="async")
    assert one.bodies[0].factors.used == other.bodies[0].factors.used
    assert records["factor_step"].tolist() == same["factor_step"].tolist()


def test_what_was_lost_is_lost_to_the_factor_in_use():
    driver, records = adaptive(-2.0, 60, update="adaptive", warp=True)
    newest = records["factor_step"][-1]
    of_it = records[records["factor_step"] == newest]
    assert driver.bodies[0].solves.lost == np.maximum(of_it["iterations"] - 3, 0).sum()


def test_no_bound_where_no_factor_is_made():
    assert Driver(falling(preconditioner="jacobi")).age_bound() == -1


def test_an_object_whose_matrix_always_fails_does_not_take_the_turns_of_the_others():
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(3)), update="async")
    driver, jobs = Driver(sim, counted=True), []
    submit = driver.inline.submit

    def broken(job: Job) -> bool:
        jobs.append(job.object)
        values = np.nan * job.values if job.object == "beam1" else job.values
        return submit(Job(job.object, job.epoch, job.step, job.warp, values, job.dtype))

    driver.inline.submit = broken  # type: ignore[method-assign]
    driver.advance(60)
    assert jobs.count("beam1") <= 7 < min(jobs.count("beam0"), jobs.count("beam2"))


def test_cost_of_a_factorization_is_the_sum_of_squared_column_lengths():
    sim = falling()
    sim.engine.assemble()
    pattern, _ = factor_of(sim)
    lengths = np.diff(np.append(pattern.diagonal, pattern.nonzeros))
    assert flops(pattern) == pytest.approx(float((lengths.astype(float) ** 2).sum()))


def test_a_failed_factorization_does_not_stop_a_run(caplog):
    """In lockstep the step at which it was due goes on with the factor before, and a new matrix goes out."""
    sim = falling(update="lockstep-3")
    driver = Driver(sim, Failing(patterns_of(sim), bad={3}))
    with caplog.at_level(logging.WARNING):
        records = driver.advance(13)
    assert records["factor_step"].tolist() == [-1, -1, -1, 0, 0, 0, 0, 0, 0, 6, 6, 6, 9]
    assert (records["status"] == 0).all()
    assert driver.bodies[0].failures.refused == 1
    assert "object 'bar': no factor: matrix: not positive definite" in caplog.text


@pytest.mark.parametrize("update", ["never", "every-1", "lockstep-2", "async", "adaptive"])
def test_a_matrix_without_a_factor_leaves_block_jacobi(update, monkeypatch):
    """Every factorization fails: the run is that of block Jacobi, to the last bit."""
    plain = falling(preconditioner="block_jacobi")
    plain.engine.run(8)
    sim = falling(update=update)
    driver = Driver(sim)
    submit = driver.inline.submit

    def spoilt(job: Job) -> bool:
        return submit(Job(job.object, job.epoch, job.step, job.warp, np.nan * job.values, job.dtype))

    monkeypatch.setattr(driver.inline, "submit", spoilt)
    records = driver.advance(8)
    assert (records["kind"] == Kind.BLOCK_JACOBI).all()
    assert (records["factor_step"] == -1).all()
    assert driver.bodies[0].failures.refused >= 1
    assert np.array_equal(sim.world.x, plain.world.x)


def made(driver: Driver, step: int, values: NDArray) -> Factor:
    """A factor of the first body as a worker would send it."""
    body = driver.simulation.world.bodies[0].name
    driver.inline.submit(Job(body, 1, step, True, values, "float64"))
    return driver.inline.poll()[0]


def test_an_older_factor_does_not_replace_a_newer_one():
    sim = falling(update="async")
    driver = Driver(sim, Failing(patterns_of(sim), bad=range(1000)))
    sim.engine.assemble()
    values = sim.system.values.copy()
    for step, used in ((5, 5), (3, 5), (5, 5), (7, 7)):
        driver.adopt([made(driver, step, values)])
        assert driver.advance(1)["factor_step"].tolist() == [used]
    assert driver.bodies[0].factors.used == 2


@pytest.fixture
def sent(monkeypatch) -> tuple[Driver, Factor, threading.Event]:
    """A driver of which a job is in flight, its factor as of a worker, and what lets its check go on. All factors
    count as large."""
    monkeypatch.setattr(driver_module, "LARGE", 0)
    sim = falling(update="async")
    driver = Driver(sim, Idle(patterns_of(sim), 1))
    driver.advance(3)
    state, go = driver.bodies[0], threading.Event()
    assert state.job.matrix is not None
    step, values = state.job.matrix
    factor = replace(made(driver, step, values), worker="w")
    check = driver.check.reject_reasons

    def slow(*arguments: Any) -> list[str]:
        go.wait(30)
        return check(*arguments)

    monkeypatch.setattr(driver.check, "reject_reasons", slow)
    return driver, factor, go


def test_large_factors_are_checked_beside_the_steps(sent):
    driver, factor, go = sent
    woken = threading.Event()
    driver.wake = woken.set
    memory = driver.bodies[0].job.matrix[1]
    driver.adopt([factor])
    assert driver.advance(2)["factor_step"].tolist() == [-1, -1]
    assert not woken.is_set()
    assert all(memory is not free for kept in driver.snapshots.free.values() for free in kept), "it is being read"
    go.set()
    wait([each.reasons for each in driver.checks])
    assert woken.wait(60)
    assert driver.advance(1)["factor_step"].tolist() == [factor.step]
    assert any(memory is free for kept in driver.snapshots.free.values() for free in kept)
    assert driver.bodies[0].factors.used == 1 and driver.checks == []


def test_of_two_factors_of_a_body_that_come_together_the_second_waits_for_the_check_of_the_first(sent, monkeypatch):
    """Where many small ones are checked together."""
    driver, factor, go = sent
    monkeypatch.setattr(driver_module, "LARGE", 1 << 40)
    monkeypatch.setattr(driver_module, "MANY", 1)
    driver.adopt([factor, replace(factor, step=factor.step + 1)])
    assert [len(each.factors) for each in driver.checks] == [1] and driver.bodies[0].job.checked == factor.step
    go.set()
    for newest in (factor.step, factor.step + 1):
        wait([each.reasons for each in driver.checks])
        driver.receive(driver.source, driver.adopt)
        assert driver.bodies[0].factors.newest == newest
    assert driver.bodies[0].factors.used == 2 and driver.bodies[0].job.checked == NONE


def test_a_large_factor_that_is_no_use_is_refused_beside_the_steps(sent):
    driver, factor, go = sent
    driver.adopt([replace(factor, values=np.full_like(factor.values, np.nan))])
    go.set()
    wait([each.reasons for each in driver.checks])
    assert driver.advance(2)["factor_step"].tolist() == [-1, -1]
    assert driver.bodies[0].failures.refused == 1 and not driver.bodies[0].job.in_flight


def test_a_check_that_cannot_begin_refuses_the_factor_and_the_run_goes_on(sent, monkeypatch):
    driver, factor, _ = sent

    def full(*_):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(driver.engine, "prepare_factor", full)
        driver.adopt([factor])
    driver.advance(1)
    assert driver.checks == [] and driver.bodies[0].job.checked == NONE and driver.bodies[0].failures.refused == 1


@pytest.mark.parametrize("beside", [True, False], ids=["beside the steps", "at once"])
def test_a_check_that_fails_by_itself_refuses_the_factor_and_the_run_goes_on(sent, monkeypatch, beside):
    driver, factor, go = sent
    if not beside:
        monkeypatch.setattr(driver_module, "LARGE", 1 << 40)
    check, blamed = driver.check.reject_reasons, []
    go.set()
    monkeypatch.setattr(driver.source, "factor_failed", lambda *each: blamed.append(each))
    monkeypatch.setattr(driver.check, "reject_reasons", lambda *_: {}["nose"])
    driver.adopt([factor])
    wait([each.reasons for each in driver.checks])
    assert driver.advance(2)["factor_step"].tolist() == [-1, -1]
    assert driver.bodies[0].failures.refused == 1 and not driver.checks
    (reported,) = driver.bodies[0].failures.reported
    assert reported.startswith("that of w is not used: its check failed: KeyError: 'nose' (test_policies.py")
    assert driver.counters.refusals == {"unexpected": 1} and blamed == []
    monkeypatch.setattr(driver.check, "reject_reasons", check)
    driver.adopt([replace(factor, step=driver.engine.step)])
    wait([each.reasons for each in driver.checks])
    driver.advance(1)
    assert driver.bodies[0].factors.used == 1


@pytest.fixture
def overlapping(sent) -> tuple[Driver, Idle, list[Factor], threading.Event]:
    """A driver with a factor in use, whose next one is checked, and the one after that as of a worker."""
    driver, factor, go = sent
    source = driver.source
    assert isinstance(source, Idle)
    source.idle = 3
    go.set()
    driver.adopt([factor])
    wait([each.reasons for each in driver.checks])
    driver.advance(3)
    go.clear()
    coming = []
    for _ in range(2):
        step, values = driver.bodies[0].job.matrix
        coming.append(replace(made(driver, step, values), worker="w"))
        driver.adopt(coming[-1:])
        driver.advance(2)
    return driver, source, coming, go


def test_the_next_matrix_goes_out_while_a_factor_is_checked(overlapping):
    driver, source, (second, third), go = overlapping
    assert [step for _, step in source.sent[1:]] == [second.step, third.step]
    assert [check.factors for check in driver.checks] == [[second]], "one of a body at a time"
    state = driver.bodies[0]
    assert state.job.in_flight and state.factors.used == 1
    go.set()
    for used in (2, 3):
        wait([each.reasons for each in driver.checks])
        driver.advance(1)
        assert state.factors.used == used
    assert driver.advance(1)["factor_step"].tolist() == [third.step]
    assert state.factors.newest == third.step and state.factors.latency.value > 1


@pytest.mark.parametrize("why", ["refused", "split"])
def test_what_becomes_of_a_factor_says_nothing_of_the_job_after_it(overlapping, monkeypatch, why):
    driver, _, (second, third), go = overlapping
    state = driver.bodies[0]
    if why == "refused":
        second.values[:] = np.nan
    else:
        monkeypatch.setattr(driver.source, "epoch", lambda name: 1 if state.job.checked != second.step else 2)
    go.set()
    wait([each.reasons for each in driver.checks])
    driver.receive(driver.source, lambda factors: None)
    assert state.failures.refused == 1 and state.factors.newest < second.step
    assert state.job.in_flight and state.job.sent == third.step and state.job.matrix is not None


def test_no_matrix_goes_ahead_of_a_check_after_a_refused_factor_and_none_under_adaptive(overlapping):
    driver, _, (second, _), _ = overlapping
    state = driver.bodies[0]
    state.on_reassignment()
    assert not len(driver.requests(ahead=True)), "the copies of both are in use"
    state.job.sent, driver._behind = second.step, []
    ahead = driver.requests(ahead=True)
    assert state.job.checked == second.step and ahead.body.tolist() == [0] and not ahead.in_flight[0]
    assert driver.requests().in_flight.tolist() == [True]
    state.failures.in_a_row = 1
    assert not len(driver.requests(ahead=True))
    assert not Adaptive.goes_ahead


@pytest.mark.parametrize(("sign", "used"), [(1, 1), (-1, 0), (None, 1)])
def test_what_applies_a_factor_beside_its_check_is_believed_in_its_place(sent, monkeypatch, sign, used):
    """sign: of what it tells to be P^-1 r; None: it comes to nothing, and the check applies the factor itself."""
    driver, factor, go = sent
    dropped: list[Factor] = []

    def prepare(body: int, given: Factor, r: np.ndarray) -> Any:
        assert body == 0 and given is factor
        return lambda: None if sign is None else sign * applied(factor.pattern, factor.values)(r)

    monkeypatch.setattr(driver.engine, "prepare_factor", prepare)
    monkeypatch.setattr(driver.engine, "drop_factor", lambda body, given: dropped.append(given))
    driver.adopt([factor])
    go.set()
    wait([each.reasons for each in driver.checks])
    records = driver.advance(2)
    assert (records["factor_step"] == (factor.step if used else -1)).all()
    assert driver.bodies[0].factors.used == used and dropped == ([] if used else [factor])


def test_excess_iterations_are_summed_until_the_next_matrix_goes_out():
    sim = falling(update="async", update_floor_iterations=3)
    driver = Driver(sim, Failing(patterns_of(sim), bad=range(1000)))
    driver.wants_factors = False  # nothing goes out
    records = driver.advance(10)
    assert driver.bodies[0].solves.excess == np.maximum(records["iterations"] - 3, 0).sum() > 0


def solved(iterations: int, factor_step: int, step: int) -> Any:
    """A record of a solve."""
    record = np.zeros(1, RECORD)[0]
    record["iterations"], record["factor_step"], record["step"] = iterations, factor_step, step
    return record


def test_the_sum_begins_anew_with_the_factor_and_comes_back_where_there_is_none():
    sim = falling(update="async")
    driver = Driver(sim, Inline(patterns_of(sim)))
    state, values = driver.bodies[0], sim.system.values
    sim.engine.assemble()

    def factor(step: int) -> Factor:
        driver.inline.submit(Job("bar", 1, step, True, values))
        return driver.inline.poll()[0]

    assert state.on_factor(factor(0), 1)
    for step, iterations in ((1, 5), (2, 9), (3, 10)):
        state.observe(solved(iterations, 0, step), 3, 1.0)
    assert (state.solves.excess, state.solves.latest, state.solves.lost) == (2 + 6 + 7, 7, 15)
    state.on_sent(3)
    state.observe(solved(12, 0, 4), 3, 1.0)
    assert (state.solves.excess, state.solves.latest) == (9, 9)
    state.on_failure("lost")
    assert state.solves.excess == 9 + 15, "nothing was done about it"
    state.on_sent(5)
    state.observe(solved(20, 0, 6), 3, 1.0)
    assert state.on_factor(factor(5), 7)
    assert (state.solves.excess, state.solves.latest, state.solves.lost) == (2, 2, 0), (
        "what the first solve with a new factor usually has"
    )
    state.observe(solved(40, 0, 7), 3, 1.0)  # made before the factor was taken up
    assert (state.solves.excess, state.solves.latest, state.solves.lost) == (2, 2, 0)
    state.observe(solved(4, 5, 8), 3, 1.0)
    assert (state.solves.excess, state.solves.latest, state.solves.lost) == (1, 1, 1)


def test_records_of_many_steps_count_as_one_after_another():
    """For runs by the clock there is a quick way; the factor in use changes in some bodies and not in others."""
    rng, bodies = np.random.default_rng(0), [bar(name=f"b{k}", young=1e6, fixed="X < 0.01") for k in range(5)]
    one, all_at_once = (Driver(falling(*bodies, update="async"), counted=False) for _ in range(2))
    for batch in range(6):
        records = np.zeros((7, 5), RECORD)
        records["step"] = 7 * batch + np.arange(1, 8)[:, None]
        records["iterations"], records["solve"] = rng.integers(0, 12, (7, 5)), rng.random((7, 5))
        records["factor_step"], records["body"] = -1 if not batch else 7 * (batch - 1), np.arange(5)
        records["factor_step"][4:, 1:3] = 7 * batch
        records["fallbacks"][2, 3], records["linearizations"][3] = 1, 2
        for driver in (one, all_at_once):
            for t in driver.bodies:
                t.factors.newest = 7 * batch if t.body.index in (1, 2) and batch else t.factors.newest
                t.factors.newest = 7 * (batch - 1) if t.body.index == 0 and batch else t.factors.newest
        for k in range(7):
            one.observe(records[k])
        all_at_once.observe(records.ravel())
        for a, b in zip(one.bodies, all_at_once.bodies, strict=True):
            assert (a.solves.excess, a.solves.latest, a.solves.lost, a.solves.factor_step) == (
                b.solves.excess,
                b.solves.latest,
                b.solves.lost,
                b.solves.factor_step,
            )
            assert (a.failures.refused, a.solves.max_factor_age) == (b.failures.refused, b.solves.max_factor_age)
            assert a.solves.iteration_cost.value == pytest.approx(b.solves.iteration_cost.value, rel=1e-12)


def test_a_poisoned_factor_that_reached_the_loop_is_counted_as_refused():
    """Past the check (test_factor_check.py), which looks at one vector only."""
    sim = falling(update="async")
    driver = Driver(sim, Failing(patterns_of(sim), bad=range(1000)))
    driver.advance(1)
    before = driver.bodies[0].failures.refused
    factor = made(driver, 5, sim.system.values)
    factor.values[7] = np.nan
    sim.engine.post_factor(0, factor.pattern, factor.values, 5)
    record = driver.advance(1)[0]
    assert (record["status"], record["fallbacks"], record["kind"]) == (0, 1, Kind.BLOCK_JACOBI)
    assert driver.bodies[0].failures.refused >= before + 1


@pytest.mark.parametrize("update", ["every-1", "lockstep-2", "async", "never"])
def test_stopped_means_no_more_steps(update):
    sim = falling(update=update)
    driver = Driver(sim)
    driver.advance(3)
    sim.engine.loop.stop = 1
    x = sim.world.x.copy()
    assert len(driver.advance(4)) == 0
    assert sim.engine.step == 3
    assert np.array_equal(sim.world.x, x)


class Unready(Inline):
    """Workers that are there and never idle; after a while somebody stops the run. workers: their names."""

    def __init__(self, sim: Simulation, workers: list[str]):
        super().__init__(patterns_of(sim))
        self._engine, self._workers, self._asked = sim.engine, workers, 0

    def worker_count(self) -> int:
        return len(self._workers)

    def ready(self) -> bool:
        self._asked += 1
        if self._workers and self._asked > 10:
            self._engine.loop.stop = 1
        return False


def test_lockstep_that_waits_for_a_busy_worker_can_be_stopped():
    sim = falling(update="lockstep-2")
    assert len(Driver(sim, Unready(sim, ["busy"])).advance(5)) == 1
    assert sim.engine.step == 1


def test_lockstep_without_workers_says_once_that_it_makes_the_factors_itself(caplog):
    sim = falling(update="lockstep-2")
    with caplog.at_level(logging.WARNING):
        records = Driver(sim, Unready(sim, [])).advance(4)
    assert records["factor_step"].tolist() == [-1, -1, 0, 0]
    assert caplog.text.count("without a worker") == 1


def test_auto_takes_the_factor_where_steps_are_hard_and_leaves_it_where_they_are_easy():
    """Costs are counted in bytes here (not async), so that the answer is the same on every machine."""
    hard = bar((10, 3, 3), (10, 2, 2), young=1e7, fixed="X < 0.01")
    easy = bar((10, 3, 3), (10, 2, 2), young=1e3, fixed="X < 0.01")
    for body, dt, kind in ((hard, 0.03, Kind.CHOLESKY), (easy, 0.001, Kind.BLOCK_JACOBI)):
        sim = simulation(
            body, gravity=(0, -9.81, 0), dt=dt, preconditioner="auto", update="lockstep-5", max_iterations=2000,
            warm_start=False,  # a guess leaves the easy one nothing to do in every other step
        )  # fmt: skip
        records = Driver(sim).advance(60)
        assert (records["status"] == 0).all()
        assert (records["kind"][20:] == kind).mean() > 0.9


@pytest.mark.parametrize("preconditioner", ["incomplete_cholesky", "ssor_factor"])
@pytest.mark.parametrize("update", ["never", "every-2", "lockstep-2", "async"])
def test_incomplete_factors_under_every_policy(preconditioner, update):
    """They come and go as Cholesky factors do, and a run repeats to the last bit."""
    options = {"preconditioner": preconditioner, "drop_tolerance": 0.05, "update": update}
    runs = []
    for _ in range(2):
        sim = falling(**options)
        records = Driver(sim).advance(12)
        assert (records["status"] == 0).all()
        runs.append((sim.world.x.tobytes(), records["iterations"].tolist(), records["factor_step"].tolist()))
    assert runs[0] == runs[1]
    assert runs[0][2] == factor_steps(update, 12)
    plain = Driver(falling(preconditioner="block_jacobi")).advance(12)
    assert sum(runs[0][1]) < sum(plain["iterations"])


def test_sweeps_need_no_factor():
    records = Driver(falling(preconditioner="ssor", omega=1.2, update="every-1")).advance(8)
    plain = Driver(falling(preconditioner="block_jacobi")).advance(8)
    assert (records["kind"] == Kind.SSOR).all() and (records["factor_step"] == -1).all()
    assert (records["status"] == 0).all()
    assert records["iterations"].sum() < 0.7 * plain["iterations"].sum()


def test_a_factor_of_a_matrix_that_was_not_positive_definite_is_used_and_counted():
    sim = falling(update="lockstep-2")
    driver = Driver(sim)
    submit, bad = driver.inline.submit, {2}

    def spoilt(job: Job) -> bool:
        if job.step in bad:  # the last node pushes where it should pull
            start, columns = sim.system.row_start, sim.system.columns
            own = np.flatnonzero(columns[start[-2] :] == len(start) - 2)[0] + start[-2]
            job.values[own] -= 1.01 * np.linalg.eigvalsh(job.values[own])[-1] * np.eye(3)
        return submit(job)

    driver.inline.submit = spoilt  # type: ignore[method-assign]
    records = driver.advance(9)
    assert records["factor_step"].tolist() == [-1, -1, 0, 0, 2, 2, 4, 4, 6]
    assert (records["status"] == 0).all()
    assert (driver.bodies[0].factors.used, driver.bodies[0].factors.regularized, driver.bodies[0].failures.refused) == (
        4,
        1,
        0,
    )
