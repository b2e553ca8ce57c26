# SPDX-License-Identifier: MIT
"""Which records a log gets that cannot follow, and that a replay repeats the run by them to the bit."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from protocol.log_file import KEPT_EVERY
from sim_server.backends.cpu.structs import RECORD
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import ROW, Recording, filled
from sim_server.replay.run import Replay
from sim_server.service import telemetry as module
from sim_server.service.log_thinning import EVENTS, GIVEN, LogThinning
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.log.test_replay_of_factors import beam, run
from tests.scenes import bar, simulation


def steps(count: int, bodies: int, seed: int) -> np.ndarray:
    """Records of steps in which now and then something happens to a body."""
    rng, r = np.random.default_rng(seed), np.zeros((count, bodies), RECORD)
    r["step"], r["body"], r["bad_node"] = np.arange(1, count + 1)[:, None], np.arange(bodies), -1
    r["factor_step"] = np.cumsum(rng.random((count, bodies)) < 0.1, axis=0) - 1
    for name in ("kind", "asked", "probe", "status", *EVENTS):
        r[name] = (rng.random((count, bodies)) < 0.03) * rng.integers(1, 4, (count, bodies))
    r["bad_node"][rng.random((count, bodies)) < 0.02] = 3
    return r.ravel()


def one_by_one(records: np.ndarray, behind: list[bool]) -> list[tuple[int, int]]:
    """What is to be chosen, by record: number and how many of its body were left out before."""
    before: dict[int, Any] = {}
    left: dict[int, int] = {}
    chosen = []
    for k, (r, late) in enumerate(zip(records, behind, strict=True)):
        body = int(r["body"])
        given = tuple(int(r[name]) for name in GIVEN)
        well = r["status"] == pb.CONVERGED and r["bad_node"] < 0 and not any(r[name] > 0 for name in EVENTS)
        if late and well and before.get(body) == given and r["step"] % KEPT_EVERY:
            left[body] = left.get(body, 0) + 1
        else:
            chosen.append((k, left.pop(body, 0)))
        before[body] = given
    return chosen


@pytest.mark.parametrize("seed", range(8))
def test_what_is_chosen_is_what_has_news(seed):
    """Of any batches, some of which come while the log is behind."""
    rng, bodies = np.random.default_rng(seed), 1 + seed % 4
    records, thinning = steps(150, bodies, seed), LogThinning(bodies)
    found, behind, at = [], [], 0
    while at < len(records):
        size, late = bodies * int(rng.integers(0, 30)), bool(rng.random() < 0.7)
        part = records[at : at + size]
        numbers, left_out = thinning.choose(part, late)
        found += list(zip((at + numbers).tolist(), left_out.tolist(), strict=True))
        behind += [late] * len(part)
        at += size
    assert found == one_by_one(records, behind)
    assert thinning.choose(records[:0], True)[0].size == 0
    assert thinning.count == len(records) - len(found) > len(records) / 4
    assert max(left for _, left in found) < KEPT_EVERY


def test_all_is_chosen_while_the_log_follows():
    records, thinning = steps(20, 3, 0), LogThinning(3)
    numbers, left_out = thinning.choose(records, False)
    assert numbers.tolist() == list(range(60)) and not left_out.any() and thinning.count == 0


def rows_of(numbers: list[int]) -> np.ndarray:
    rows = np.zeros(len(numbers), ROW)
    rows["step"], rows["factor_step"], rows["status"] = numbers, [10 * n for n in numbers], 2
    return rows


def test_rows_that_were_left_out_are_those_before_them():
    rows, empty = filled(rows_of([1, 2, 5, 6, 9]), {5: 2, 9: 2})
    assert rows["step"].tolist() == list(range(1, 10))
    assert rows["factor_step"].tolist() == [10, 20, 20, 20, 50, 60, 60, 60, 90]
    assert empty.tolist() == [False, False, True, True, False, False, True, True, False]
    assert (rows["status"][empty] == pb.CONVERGED).all() and (rows["status"][~empty] == 2).all()


@pytest.mark.parametrize("told", [{}, {5: 1}, {5: 3}, {4: 2}])
def test_other_gaps_are_losses(told):
    rows, empty = filled(rows_of([1, 2, 5, 6]), told)
    assert rows["step"].tolist() == [1, 2, 5, 6] and not empty.any()


def test_a_log_cannot_ask_for_rows_without_bounds():
    rows, _ = filled(rows_of([1, 1 << 40]), {1 << 40: (1 << 40) - 2})
    assert len(rows) == 2
    assert len(filled(rows_of([]), {})[0]) == 0


def logged(sim: Simulation, records: np.ndarray, path: Path, seed: int) -> int:
    """Writes a log that follows now and then; returns the number of records that it lacks."""
    thinning, rng, at = LogThinning(1), np.random.default_rng(seed), 0
    with Recorder(path) as recorder:
        recorder.scene(messages.scene(sim))
        recorder.topology(messages.topology(sim, sim.world.bodies[0]))
        for made in set(records["factor_step"].tolist()) - {-1}:
            recorder.factor(pb.FactorUse(header=pb.Header(object="bar", epoch=1), step=made, method="cholesky"))
        while at < len(records):
            part = records[at : at + int(rng.integers(1, 9))]
            at += len(part)
            numbers, left_out = thinning.choose(part, at < len(records) and bool(rng.random() < 0.8))
            recorder.steps(messages.encoded_steps(sim, part[numbers], left_out=left_out))
        w, last = sim.fetch(), len(records)
        recorder.state(messages.state(sim.world.bodies[0], last, last * w.dt, w.x, w.v))
    return thinning.count


@pytest.mark.parametrize(
    "plan", ["j jc fn f f f fc f jn jc f f f f f jn f f j j j", "of f f f f oj of f f f of oj j f f"]
)
def test_a_run_is_repeated_to_the_bit_by_a_log_that_lacks_records(plan: str, tmp_path: Path) -> None:
    sim = beam(update="every-1") if "o" in plan else beam()
    records = run(sim, plan)
    missing = logged(sim, records, tmp_path / "run.mcap", 3)
    with Recording(tmp_path / "run.mcap") as recording:
        found = Replay(recording).run()
        assert recording.steps == len(records)
    assert missing > 3 and found.same, found.lines()
    assert (found.solves_compared, found.frames_compared) == (len(records) - missing, 1)
    assert any(f"{missing} step records were left out" in note for note in found.notes)


def served(path: Path, monkeypatch: pytest.MonkeyPatch, patient: bool) -> tuple[Telemetry, list[str]]:
    """A run of 50 steps whose log is always behind."""
    monkeypatch.setattr(module, "BEHIND", -1.0)
    sim = simulation(bar(name="a"), bar(name="b"), gravity=(0, -9.81, 0), preconditioner="block_jacobi")
    driver, link, lines = Driver(sim), SimpleNamespace(wants_steps=lambda: False), []
    with Recorder(path) as recorder:
        telemetry = Telemetry(driver, link, recorder, patient=patient)  # type: ignore[arg-type]
        recorder.scene(messages.scene(sim))
        for body in sim.world.bodies:
            recorder.topology(messages.topology(sim, body))
        for _ in range(5):
            records = driver.advance(10)
            telemetry.records(records, messages.reactions(sim, driver.reactions, driver.other_reactions))
            lines += telemetry.losses()
    return telemetry, lines


def test_in_real_time_a_log_that_is_behind_is_thinned_which_is_told_and_counted(tmp_path, monkeypatch):
    telemetry, lines = served(tmp_path / "run.mcap", monkeypatch, patient=False)
    missing = telemetry.thinning.count
    assert 50 < missing < 100 and len(lines) == 1 and "the log cannot follow" in lines[0]
    with Recording(tmp_path / "run.mcap") as recording:
        assert any(f"records thinned: {missing}" in note for note in recording.notes)
        assert Replay(recording).run().same
        kept = recording.objects["a"].rows["step"][~recording.objects["a"].filled]
    assert {1, 16, 32, 48} <= set(kept.tolist())


def test_a_run_without_a_clock_waits_for_its_log_instead(tmp_path, monkeypatch):
    telemetry, lines = served(tmp_path / "run.mcap", monkeypatch, patient=True)
    assert not lines and telemetry.thinning.count == 0
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.steps == 50 and not recording.objects["b"].filled.any()


def test_steps_that_nobody_read_in_time_are_told_once():
    sim = simulation(bar(young=1e5), gravity=(0, -9.81, 0))
    telemetry = Telemetry(Driver(sim), SimpleNamespace(), None, patient=False)  # type: ignore[arg-type]
    assert not telemetry.losses()
    sim.engine.loop.records_dropped = 3
    assert len(lines := telemetry.losses()) == 1 and "not read in time" in lines[0] and not telemetry.losses()
