# SPDX-License-Identifier: MIT
"""Matrices copied ahead where workers factorize many within one step."""

import time

import numpy as np
import pytest

from protocol.factor import Factor
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.policies.free_running import Async
from sim_server.updates.prefetch import MAX_DEPTH, MAX_WAIT, MORE, SHARE, TRANSFER, PrefetchDepth
from tests.scenes import bar
from tests.updates.test_policies import falling, patterns_of


def paced(period: float, steps: int = 20) -> PrefetchDepth:
    """After so many steps of equal length [s]."""
    prefetch = PrefetchDepth()
    for step in range(steps):
        prefetch.on_step(step, step * period)
    return prefetch


@pytest.mark.parametrize(
    ("period", "service", "workers", "depth"),
    [
        (1.0, 0.004, 1, 200),
        (1.0, 0.004, 2, MAX_DEPTH),
        (0.02, 0.004, 1, 4),
        (0.02, 0.004, 0, 0),
        (0.001, 0.05, 4, 0),
        (0.02, 0.5, 3, 0),
    ],
)
def test_as_many_as_workers_can_take_within_a_step(period, service, workers, depth):
    prefetch = paced(period)
    prefetch.update(service, 3, workers)
    assert prefetch.depth == pytest.approx(depth, abs=1)
    assert TRANSFER < 0.002


def test_copies_that_take_several_steps_are_begun_ahead():
    """As on a GPU, whose steps go on while a matrix travels to the host."""
    prefetch, told = paced(0.001), (2e-4, 1000)
    prefetch.on_copy(0.01)
    prefetch.update(*told, 1, queued=True)
    assert prefetch.depth == pytest.approx(MORE * 50, abs=1), "a few more than it can make until they are there"
    assert prefetch.patience == pytest.approx(MAX_WAIT + 9, abs=1)
    prefetch.update(*told, 3, queued=True)
    assert prefetch.depth == 1000 // SHARE, "all of them would be on their way for long"
    prefetch.update(2e-4, 8000, 99, queued=True)
    assert prefetch.depth == MAX_DEPTH
    prefetch.update(*told, 1)
    assert prefetch.depth == 0, "jobs that travel one by one keep a worker waiting"


def test_nothing_is_known_before_the_first_steps_and_factors():
    prefetch = PrefetchDepth()
    prefetch.update(0.001, 1, 4)
    assert prefetch.depth == 0
    prefetch = paced(1.0)
    prefetch.update(None, 2, 4)
    assert prefetch.depth == 0


def test_the_pace_is_told_once_a_step():
    prefetch = PrefetchDepth()
    assert [prefetch.on_step(step, now) for step, now in ((0, 0.0), (0, 0.5), (2, 1.0), (2, 1.1), (3, 1.5))] == [
        False, False, True, False, True,
    ]  # fmt: skip


class OneAtATime(Inline):
    """A worker that takes one job whenever it is let; the order of what it was sent."""

    def __init__(self, patterns):
        super().__init__(patterns)
        self.idle, self.order = 1, []

    def ready(self) -> int:
        return self.idle

    def submit(self, job: Job) -> bool:
        if not self.idle:
            return False
        self.idle = 0
        self.order.append((job.object, job.step))
        return super().submit(job)


class ManyAtATime(Inline):
    """A worker that has `most` jobs at a time, each for `latency` calls of `poll`."""

    def __init__(self, patterns, most: int, latency: int):
        super().__init__(patterns)
        self.most, self.latency, self.begun, self.calls = most, latency, [], 0

    def ready(self) -> int:
        return self.most - len(self.begun)

    def submit(self, job: Job) -> bool:
        if not self.ready():
            return False
        self.begun.append((self.calls, job))
        return True

    def poll(self) -> list[Factor]:
        self.calls += 1
        while self.begun and self.begun[0][0] <= self.calls - self.latency:
            super().submit(self.begun.pop(0)[1])
        return super().poll()


@pytest.mark.parametrize("most", [1, 4])
def test_the_bound_of_ages_reckons_with_the_jobs_that_a_worker_has_at_a_time(most):
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(8)), update="async")
    driver = Driver(sim, ManyAtATime(patterns_of(sim), most, latency=3))
    ages, bounds = [], []
    for step in range(300):
        records = driver.advance(1)
        if step > 200:
            ages.append(int((records["step"] - 1 - records["factor_step"]).max()))
            bounds.append(driver.age_bound())
    latency = float(np.mean(driver.table.latency))
    rounds = sim.scene.solver.schedule_rounds + 1
    assert max(ages) <= min(bounds)
    assert max(bounds) <= rounds * 8 * latency / most * 1.5 + 2 * driver.table.latency.max() + 4


def prefetching(depth: int) -> tuple[Driver, Async, OneAtATime]:
    sim = falling(*(bar(name=f"beam{k}", young=1e6, fixed="X < 0.01") for k in range(6)), update="async")
    source = OneAtATime(patterns_of(sim))
    driver = Driver(sim, source)
    assert isinstance(driver.policy, Async)
    driver.policy.prefetch.depth = depth
    return driver, driver.policy, source


def test_prefetched_copies_go_to_the_worker_as_it_becomes_idle():
    driver, policy, source = prefetching(4)
    policy.exchange()
    driver.engine.run(1)
    for _ in range(4):
        source.idle = 1
        policy.exchange()
    assert source.order == [(f"beam{k}", 0) for k in range(4)], "all of one step, in the order of need"


def test_without_prefetching_there_is_one_copy_for_each_idle_worker():
    driver, policy, source = prefetching(0)
    policy.exchange()
    driver.engine.run(1)
    for _ in range(4):
        source.idle = 1
        policy.exchange()
    assert source.order == [("beam0", 0)]


def test_copies_that_wait_too_long_are_given_up():
    driver, policy, source = prefetching(4)
    policy.exchange()
    driver.engine.run(1)
    source.idle = 0
    driver.engine.run(MAX_WAIT + 1)
    policy.prefetch.depth = 4
    policy.exchange()
    source.idle = 1
    driver.engine.run(1)
    policy.exchange()
    assert all(step > 0 for _, step in source.order) and source.order


def test_the_matrix_of_a_body_that_needs_no_factor_is_not_prefetched():
    driver, policy, source = prefetching(6)
    for _ in range(30):
        policy.exchange()
        driver.engine.run(1)
        driver.engine.records()  # unseen: nobody's excess grows
        source.idle = 1
    sent = [name for name, _ in source.order]
    assert set(sent) == {f"beam{k}" for k in range(6)}, "who had none got one, and then those idle workers are given"
    policy.exchange()
    assert sum(t.job.copy is not None for t in driver.bodies) <= 1
    policy.prefetch.queued = True
    policy.exchange()
    assert sum(t.job.copy is not None for t in driver.bodies) > 1, "a worker takes many together"


def test_each_copy_of_a_body_alone_is_timed():
    sim = falling(bar(name="beam", young=1e6, fixed="X < 0.01"), update="async")
    source, timed = OneAtATime(patterns_of(sim)), []
    driver = Driver(sim, source)
    assert isinstance(driver.policy, Async)
    driver.policy.prefetch.on_copy = timed.append
    for sent in range(1, 4):
        source.idle = 1
        while len(source.order) < sent:
            driver.policy.exchange()
            driver.engine.run(1)
            source.idle = 1
            driver.policy.exchange()
        assert len(timed) == len(source.order)
    assert all(0 < seconds < 60 for seconds in timed)


def test_a_factor_that_comes_while_copies_are_sent_is_taken_up_in_the_same_round():
    sim = falling(bar(name="beam", young=1e6, fixed="X < 0.01"), update="async")
    driver = Driver(sim, ManyAtATime(patterns_of(sim), most=1, latency=1))
    driver.pump()
    driver.engine.run(1)
    assert driver.bodies[0].factors.used == 0
    driver.pump()
    assert driver.bodies[0].factors.used == 1


def test_counted_runs_do_not_prefetch():
    sim = falling(bar(name="beam", young=1e6, fixed="X < 0.01"), update="async")
    driver = Driver(sim, counted=True)
    for _ in range(5):
        driver.engine.run(1)
        driver.pump()
        time.sleep(0.01)
    assert isinstance(driver.policy, Async) and driver.policy.prefetch.depth == 0
