# SPDX-License-Identifier: MIT
"""A factor that passes the check and is useless is dropped once solves have abandoned it a few times."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from precond_worker.factorization.registry import make_factorization
from protocol.factor import Factor
from sim_server.backends.base import Capability
from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.useless_factors import MAX_FALLBACKS, FallbackCounter, Verdict
from tests.scenes import bar, simulation

SHARE = 0.08  # of the nodes


class Stiffened(Inline):
    """Exact factors of A with some nodes 1e3 to 1e10 times stiffer, as long as `bad`: they pass the check."""

    def __init__(self, sim: Simulation):
        (body,) = sim.world.bodies
        self.pattern = sim.system.body_pattern(body.first, body.last)
        super().__init__({body.name: self.pattern})
        self.bad, self.jobs, self.told = True, 0, []

    def submit(self, job: Job) -> bool:
        self.jobs += 1
        row_start, columns = self.pattern
        nodes, random = len(row_start) - 1, np.random.default_rng(0)
        scale = np.ones(nodes)
        chosen = random.choice(nodes, int(SHARE * nodes), replace=False)
        scale[chosen] = 10 ** random.uniform(1.5, 5.0, len(chosen)) if self.bad else 1.0
        rows = np.repeat(np.arange(nodes), np.diff(row_start))
        return super().submit(replace(job, values=job.values * (scale[rows] * scale[columns])[:, None, None]))

    def factor_failed(self, worker: str, object: str, pattern: int | None = None) -> None:
        self.told.append(("no use", worker, object))

    def factor_helped(self, worker: str, object: str) -> None:
        self.told.append(("of use", worker, object))

    def consecutive_failures(self) -> dict[str, int]:
        return {}


def run(update: str = "async", **solver: object) -> tuple[Driver, Stiffened]:
    beam = bar((12, 4, 4), young=1e6, fixed="X < 0.01")
    options = {"preconditioner": "cholesky", "max_iterations": 400, "update": update} | solver
    sim = simulation(beam, gravity=(0, -9.81, 0), **options)
    source = Stiffened(sim)
    return Driver(sim, source), source


@pytest.mark.parametrize("update", ["async", "lockstep-2"])
def test_one_that_solves_leave_is_dropped_until_another_comes(update: str, caplog: pytest.LogCaptureFixture) -> None:
    driver, source = run(update)
    state = driver.bodies[0]
    submit, source.submit = source.submit, lambda job: source.jobs == 0 and submit(job)  # one, and no other
    if update == "lockstep-2":
        source.submit = submit
    with caplog.at_level(logging.WARNING):
        records = driver.advance(20)
    left = np.flatnonzero(records["fallbacks"])
    assert (records["status"] == 0).all() and (records["residual"] <= 1e-6).all()
    if update == "async":
        assert len(left) == MAX_FALLBACKS and left[-1] - left[0] == MAX_FALLBACKS - 1
        assert (records["kind"][left[-1] + 1 :] == Kind.BLOCK_JACOBI).all()
        assert (records["factor_step"][left[-1] + 1 :] == -1).all() and state.factors.age(driver.engine.step) == -1
        assert records["iterations"][left[-1] + 1 :].max() < records["iterations"][left].min() / 2
        assert source.told == [("no use", Inline.WORKER, "bar")]
        assert [r.message for r in caplog.records] == [f"object 'bar': no factor: {state.failures.reason}"]
    assert f"not used any more: {MAX_FALLBACKS} solves in a row" in state.failures.reason
    source.bad, source.submit = False, submit
    records = driver.advance(10)
    assert records["kind"][-1] == Kind.CHOLESKY and not records["fallbacks"][-3:].any()
    assert records["iterations"][-1] < 10
    assert source.told[-1] == ("of use", Inline.WORKER, "bar") and state.factors.age(driver.engine.step) >= 0


def test_bad_ones_one_after_another_are_each_dropped() -> None:
    """Though another takes the place of each before three solves were made with it: every solve left its factor."""
    driver, source = run()
    records = driver.advance(24)
    assert source.jobs > 4
    assert records["fallbacks"].sum() <= len(records) / 2 and len(source.told) > 2
    assert {what for what, *_ in source.told} == {"no use"}


def test_auto_without_its_factor_tries_the_next_one() -> None:
    driver, source = run(preconditioner="auto")
    tuner, state = driver.bodies[0].tuner, driver.bodies[0]
    assert tuner is not None
    source.bad, submit = False, source.submit
    driver.advance(10)
    source.submit = lambda job: False
    driver.advance(4)
    driver.useless_factors.drop(state)
    assert (tuner.kind, tuner.probe, state.factors.age(driver.engine.step)) == (Kind.BLOCK_JACOBI, 0, -1)
    assert driver.engine.settings(0).kind == Kind.BLOCK_JACOBI
    records = driver.advance(4)
    assert (records["asked"] == Kind.BLOCK_JACOBI).all(), "no probe with what was dropped"
    source.submit = submit
    records = driver.advance(8)
    assert (records["asked"] == Kind.CHOLESKY).any() and state.factors.dropped is None


@pytest.mark.parametrize("update", ["never", "every-5"])
def test_where_no_other_would_come_none_is_dropped(update: str) -> None:
    driver, _ = run(update)
    driver.inline = Stiffened(driver.simulation)  # type: ignore[assignment]
    records = driver.advance(8)
    assert (records["kind"] == Kind.BLOCK_JACOBI).all() and records["fallbacks"].all()


def test_what_is_found_is_told_once_of_each_factor() -> None:
    use = FallbackCounter()
    assert use.observe(1, abandoned=False, used=True) is Verdict.USEFUL
    assert use.observe(1, abandoned=False, used=True) is None
    found = [use.observe(1, abandoned=True, used=False) for _ in range(MAX_FALLBACKS + 1)]
    assert found == [None] * (MAX_FALLBACKS - 1) + [Verdict.USELESS, None]
    assert use.observe(5, abandoned=True, used=False) is Verdict.USELESS, "the next one, at once"
    assert use.observe(6, abandoned=False, used=False) is None, "a probe that went over to block Jacobi"
    assert use.observe(7, abandoned=False, used=True) is Verdict.USEFUL
    assert [use.observe(7, abandoned=True, used=False) for _ in range(2)] == [None, None]
    assert use.observe(7, abandoned=False, used=True) is None
    assert use.observe(7, abandoned=True, used=False) is None, "not in a row"


def test_a_refused_factor_is_told() -> None:
    driver, source = run()
    values = np.full(3, np.nan)
    body = driver.simulation.world.bodies[0]
    row_start, columns = driver.simulation.system.body_pattern(body.first, body.last)
    pattern = make_factorization(row_start, columns, driver.solver.method).pattern
    driver.adopt([Factor("bar", 1, 5, False, pattern, values, "w", 0.1, "")])
    assert source.told == [("no use", "w", "bar")]


def test_a_loop_that_takes_the_next_one_later_goes_without_until_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, where a factor is expanded beside the steps: solves would begin with the dropped one again."""
    driver, source = run()
    submit = source.submit
    source.submit = lambda job: source.jobs == 0 and submit(job)
    driver.advance(8)
    state, settings = driver.bodies[0], driver.engine.settings(0)
    dropped = state.factors.newest
    assert state.factors.dropped == (dropped, Kind.CHOLESKY) and settings.kind == Kind.BLOCK_JACOBI
    in_use = [dropped]
    monkeypatch.setattr(driver.engine, "capabilities", driver.engine.capabilities - {Capability.EXACT_STEPS})
    monkeypatch.setattr(driver.engine, "factor_step", lambda body: in_use[0])
    source.bad, source.submit = False, submit
    records = driver.advance(6)
    assert state.factors.newest > dropped and (records["asked"] == Kind.BLOCK_JACOBI).all()
    in_use[0] = state.factors.newest
    driver.advance(2)
    assert state.factors.dropped is None and settings.kind == Kind.CHOLESKY
