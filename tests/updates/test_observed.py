# SPDX-License-Identifier: MIT
"""Records that are summed up many at a time say the same as one after another, and cost messages only if wanted."""

from types import SimpleNamespace

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.recording import messages
from sim_server.service.telemetry import Telemetry
from sim_server.updates.driver import Driver
from sim_server.updates.solve_observer import MIN_TOGETHER
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


def told(listening: bool, monkeypatch) -> tuple[list[pb.Steps], list[pb.Status], int]:
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
    sent, statuses, made = told(False, monkeypatch)
    assert (sent, made) == ([], 0)
    assert [o.last.step for o in statuses[0].objects] == [10] * BODIES
    r = solves(np.random.default_rng(0), 0, 10)
    assert [o.mean_iterations for o in statuses[0].objects] == pytest.approx(r["iterations"].mean(axis=0).tolist())


def test_a_listener_gets_every_step(monkeypatch):
    sent, _, made = told(True, monkeypatch)
    assert made == 30 and [s.step for s in sent[0].steps] == sorted([*range(1, 11)] * 3) and sent[0].left_out == 0


def test_a_listener_is_told_how_many_were_left_out(monkeypatch):
    monkeypatch.setattr("sim_server.service.telemetry.MAX_BATCH", 7)
    sent, _, made = told(True, monkeypatch)
    assert made == 7 and len(sent[0].steps) == 7 and sent[0].left_out == 23
