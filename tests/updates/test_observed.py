# SPDX-License-Identifier: MIT
"""Records that are summed up many at a time say the same as one after another, and cost messages only if wanted."""

from types import SimpleNamespace

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from protocol.factor import Factor
from protocol.method import Method
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.recording import messages
from sim_server.service.telemetry import Telemetry
from sim_server.updates.body_state import MadeFactors, on_checks, on_factors
from sim_server.updates.driver import Driver
from sim_server.updates.scheduler import pick
from sim_server.updates.solve_observer import MIN_TOGETHER
from sim_server.updates.update_table import ABANDONED, NONE, RAN_AWAY, UpdateTable, told
from tests.scenes import bar, simulation

BODIES, STEPS = 3, 40


def drivers(preconditioner: str) -> list[Driver]:
    """Two of the same scene, whose loops run freely."""
    found = []
    for _ in range(2):
        bodies = [bar(name=name, young=1e5, fixed="X < 0.01") for name in "abc"]
        sim = simulation(*bodies, gravity=(0, -9.81, 0), preconditioner=preconditioner, update="async")
        found.append(Driver(sim, counted=False))
    return found


def solves(rng: np.random.Generator, first: int, steps: int, kind: Kind = Kind.CHOLESKY) -> np.ndarray:
    """Records (steps, bodies) as a loop gives them; a new factor now and then."""
    r = np.zeros((steps, BODIES), RECORD)
    r["step"] = first + np.arange(1, steps + 1)[:, None]
    r["body"] = np.arange(BODIES)
    r["factor_step"] = (r["step"] - 1) // 7 * 7 - 7
    r["iterations"] = rng.integers(0, 12, r.shape)
    r["solve"] = rng.uniform(1e-4, 1e-3, r.shape)
    r["linearizations"] = 1
    r["kind"] = r["asked"] = np.where(rng.random(r.shape) < 0.8, kind, Kind.BLOCK_JACOBI)
    r["fallbacks"] = rng.random(r.shape) < 0.1
    return r


def seen(driver: Driver) -> list[tuple]:
    """What the scheduler and `auto` know."""
    out = []
    for t in driver.bodies:
        exact = (
            t.solves.excess,
            t.solves.latest,
            t.solves.lost,
            t.solves.factor_step,
            t.solves.max_factor_age,
            t.solves.first_excess.value,
            t.failures.refused,
        )
        tuner = () if t.tuner is None else (t.tuner.kind, t.tuner.probe)
        out.append((*exact, *tuner))
    return out


@pytest.mark.parametrize("preconditioner", ["cholesky", "auto"])
@pytest.mark.parametrize("at_once", [3, 8])
def test_many_records_say_what_each_says(preconditioner, at_once):
    one, many = drivers(preconditioner)
    rng = np.random.default_rng(at_once)
    for first in range(0, STEPS * at_once, at_once):
        r = solves(rng, first, at_once)
        for t in (*one.bodies, *many.bodies):
            t.factors.newest = max(t.factors.newest, int(r["factor_step"].max()))
        assert r.size >= MIN_TOGETHER
        many.observe(r.ravel())
        for record in r.ravel():  # fewer than are summed up together
            one.observe(record.reshape(1))
        assert seen(one) == seen(many)
        for a, b in zip(one.bodies, many.bodies, strict=True):
            assert a.solves.iteration_cost.value == pytest.approx(b.solves.iteration_cost.value, rel=1e-9)
    assert one.bodies[0].solves.excess > 0


def noted(driver: Driver) -> list[tuple]:
    """What is known of the factors of each body."""
    out = []
    for t in driver.bodies:
        f = t.factors
        counts = (f.newest, f.used, f.regularized, t.job.in_flight, t.job.sent, t.job.checked, t.failures.in_a_row)
        sums = (f.latency.value, f.cost.value, t.solves.excess, t.solves.latest, t.solves.lost, f.workers)
        out.append((*counts, *sums, {name: mean.value for name, mean in f.cost_by_method.items()}))
    return out


def test_many_factors_say_what_each_says():
    """Late ones, ones that nobody asked for, from here and from elsewhere; after failures and with excess summed up."""
    one, many = drivers("auto")  # by which methods are remembered
    rng = np.random.default_rng(0)
    for step in range(10, 200, 3):
        chosen = rng.permutation(BODIES)[: rng.integers(1, BODIES + 1)].tolist()
        checked, newer = rng.random((2, BODIES)) < 0.5
        asked, failed, lost = rng.random(BODIES) < 0.5, rng.random(BODIES) < 0.2, rng.uniform(0, 9, BODIES)
        factors = {}
        for k in chosen:
            made = int(step - rng.integers(0, 9)) if asked[k] else int(rng.integers(0, step))
            remedy = "shifted" if rng.random() < 0.2 else ""
            factors[k] = Factor(
                "abc"[k], 1, made, True, None, None, f"w{step % 4}", float(rng.uniform(0, 1e-3)), remedy
            )
        for driver in (one, many):
            for k, factor in factors.items():
                state = driver.bodies[k]
                state.solves.excess, state.solves.lost = lost[k], 2 * lost[k]
                state.solves.first_excess.add(lost[k] / 3)
                if failed[k]:
                    state.failures.in_a_row += 1
                if asked[k]:
                    state.on_job(factor.step, Method())
                    state.job.in_flight, state.job.sent = True, factor.step
                    if checked[k]:  # beside the steps, and a newer matrix was sent meanwhile, or none
                        on_checks(driver.table, [state.body.index], [factor.step])
                        state.job.in_flight, state.job.sent = bool(newer[k]), factor.step + int(newer[k])
        expected = [one.bodies[k].on_factor(factor, step) for k, factor in factors.items()]
        bodies = np.array(list(factors))
        assert on_factors(many.bodies, bodies, MadeFactors.of(list(factors.values())), step) == expected
        assert noted(one) == noted(many)
    assert min(t.factors.used for t in one.bodies) > 5
    assert one.bodies[0].factors.cost_by_method and one.bodies[0].factors.regularized


@pytest.mark.parametrize("ahead", [False, True])
def test_requests_say_what_the_table_holds(ahead):
    """Of every mixture of what may be known of a body."""
    rng, bodies, step = np.random.default_rng(3), 600, 50
    table = UpdateTable(bodies)
    for column in (table.excess, table.latest, table.lost):
        column[:] = rng.uniform(0, 9, bodies)
    for column in (table.iteration_cost, table.cost):
        column[:] = np.where(rng.random(bodies) < 0.3, np.nan, rng.uniform(1e-6, 1e-3, bodies))
    for column in (table.newest, table.sent):
        column[:] = rng.integers(-1, step, bodies)
    table.checked[:] = np.where(rng.random(bodies) < 0.5, table.sent, rng.integers(-1, step, bodies))
    table.failures[:] = rng.integers(0, 3, bodies)
    for column in (table.dropped, table.in_flight, table.copying, table.frozen):
        column[:] = rng.random(bodies) < 0.3
    on_trial, compared = (rng.random((2, bodies)) < 0.4).tolist()
    age = np.where((table.newest >= 0) & ~table.dropped, step - table.newest, NONE)
    checked = table.checked != NONE
    wanted = ~table.frozen
    if ahead:
        wanted &= checked & (table.sent == table.checked) & (age >= 0) & (table.failures == 0) & ~np.array(compared)
    assert 0 < wanted.sum() < bodies
    expected = {
        "body": np.arange(bodies), "age": age, "waited": np.where(table.sent >= 0, step - table.sent, NONE),
        "in_flight": table.in_flight | table.copying | (checked & (not ahead)), "failures": table.failures,
        "excess": table.excess, "latest": table.latest, "lost": table.lost, "on_trial": np.array(on_trial),
        "iteration_cost": np.nan_to_num(table.iteration_cost, nan=1.0),
        "factorization_cost": np.nan_to_num(table.cost, nan=1.0),
    }  # fmt: skip
    found = table.requests(step, ahead, on_trial, compared)
    assert {name: getattr(found, name).tolist() for name in expected} == {
        name: column[wanted].tolist() for name, column in expected.items()
    }
    assert pick(found, 9) == pick(found.of(np.arange(len(found))), 9)
    flying = table.in_flight | checked
    assert table.counts() == (table.copying.sum(), flying.sum(), (table.failures > 0).sum())


def test_means_are_of_what_is_known():
    table = UpdateTable(4)
    assert table.mean(table.cost) is None
    table.cost[[0, 2]] = 1.0, 4.0
    assert table.mean(table.cost) == 2.5
    table.cost[:] = 3.0
    assert table.mean(table.cost) == 3.0


def test_records_tell_of_bodies_that_ran_away_and_of_factors_that_were_left():
    records = np.zeros(9, RECORD)
    assert told(records[:0]) == told(records) == 0
    records["fallbacks"][7] = 2
    assert told(records) == ABANDONED and told(records[:7]) == 0
    records["status"][3] = pb.RUNAWAY
    assert told(records) == ABANDONED | RAN_AWAY and told(records[:7]) == RAN_AWAY


def published(listening: bool, monkeypatch) -> tuple[list[pb.Steps], list[pb.Status], int]:
    """Steps and statuses that went out, and how many messages of steps were made before the status was."""
    driver = drivers("cholesky")[0]
    made, sent, statuses = [], [], []
    plain = messages.encoded_steps
    monkeypatch.setattr(
        messages, "encoded_steps", lambda sim, records, *more, **rest: made.extend(records) or plain(sim, records)
    )
    link = SimpleNamespace(wants_steps=lambda: listening, publish_steps=sent.append, publish_status=statuses.append)
    telemetry = Telemetry(driver, link, None, patient=False)  # type: ignore[arg-type]
    records = solves(np.random.default_rng(0), 0, 10).ravel()
    none = messages.reactions(driver.simulation, np.zeros((len(records), 0, 6)), driver.other_reactions)
    telemetry.records(records, none)
    before = len(made)
    telemetry.publish_status("running")
    return sent, statuses, before


def test_steps_become_messages_only_if_somebody_listens(monkeypatch):
    sent, statuses, made = published(False, monkeypatch)
    assert (sent, made) == ([], 0)
    assert [o.last.step for o in statuses[0].objects] == [10] * BODIES
    r = solves(np.random.default_rng(0), 0, 10)
    assert [o.mean_iterations for o in statuses[0].objects] == pytest.approx(r["iterations"].mean(axis=0).tolist())


def test_a_listener_gets_every_step(monkeypatch):
    sent, _, made = published(True, monkeypatch)
    assert made == 30 and [s.step for s in sent[0].steps] == sorted([*range(1, 11)] * 3) and sent[0].left_out == 0


def test_a_listener_is_told_how_many_were_left_out(monkeypatch):
    monkeypatch.setattr("sim_server.service.telemetry.MAX_BATCH", 7)
    sent, _, made = published(True, monkeypatch)
    assert made == 7 and len(sent[0].steps) == 7 and sent[0].left_out == 23
