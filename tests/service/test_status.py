# SPDX-License-Identifier: MIT
"""What the status says of records that nobody got, and how the client shows it."""

import io
from threading import Thread
from types import SimpleNamespace

import numpy as np
from rich.console import Console

from clients.watch import tables
from protocol import messages_pb2 as pb
from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.effect_table import EFFECT_CASES
from tests.scenes import bar, simulation


def status(recorder: SimpleNamespace | None) -> pb.Status:
    """Of a run whose loop and log have lost something."""
    sim, found = simulation(bar(young=1e5), gravity=(0, -9.81, 0)), []
    link = SimpleNamespace(publish_status=found.append)
    telemetry = Telemetry(Driver(sim), link, recorder, patient=False)  # type: ignore[arg-type]
    sim.engine.loop.records_dropped, sim.engine.loop.frames_dropped = 5, 2
    telemetry.publish_status("running")
    return found[0]


def test_the_status_counts_what_the_loop_dropped_and_what_the_log_lost():
    found = status(SimpleNamespace(dropped=3, lost=7, failure="/x.mcap: No space left on device"))
    assert found.recording_failure == "/x.mcap: No space left on device" and not status(None).recording_failure
    assert (found.records_dropped, found.records_lost, found.frames_dropped) == (5, 7, 2 + 3)
    assert status(None).records_lost == 0


def test_the_client_shows_these_numbers():
    text = io.StringIO()
    Console(width=200, file=text).print(tables(pb.Status(frames_dropped=4, records_dropped=51, records_lost=62)))
    assert "dropped: frames 4, step records 51; lost to the log 62, left out of it 0" in text.getvalue()
    assert "the log is not whole" not in text.getvalue()
    Console(width=200, file=text).print(tables(pb.Status(recording_failure="/x.mcap: No space left on device")))
    assert "the log is not whole: /x.mcap: No space left on device" in text.getvalue()


def test_what_goes_wrong_is_counted_by_object_and_shown():
    """One iteration does not solve a stiff bar; gravity of no number ends in not_finite."""
    sim, found = simulation(bar(young=1e5), gravity=(0, -9.81, 0), max_iterations=1), []
    driver = Driver(sim)
    telemetry = Telemetry(driver, SimpleNamespace(publish_status=found.append), None, patient=False)  # type: ignore[arg-type]
    telemetry.summary.update(driver.advance(3))
    sim.world.v[:] = np.nan
    telemetry.summary.update(driver.advance(1))
    telemetry.publish_status("running")
    counts = {e.event: e.steps for e in found[0].objects[0].events}
    assert counts == {"max_iterations": 3, "not_finite": 1}
    text = io.StringIO()
    Console(width=200, file=text).print(tables(found[0]))
    assert "max_iterations 3, not_finite 1" in text.getvalue()
    telemetry.summary.events.clear(0)
    telemetry.publish_status("running")
    assert not found[1].objects[0].events


def test_the_client_shows_the_workers_that_the_server_supervises():
    workers = [
        pb.LocalWorker(worker="local-1", state="running", pid=71),
        pb.LocalWorker(worker="local-2", state="restarting", pid=72, restarts=3, exit_code=-9),
        pb.LocalWorker(worker="local-3", state="given up", pid=73, restarts=5, exit_code=1),
    ]
    text = io.StringIO()
    Console(width=80, file=text).print(tables(pb.Status(local_workers=workers)))
    rows = {line.split()[0]: line.split()[1:] for line in text.getvalue().splitlines() if "local-" in line}
    assert rows["local-1"] == ["running", "71", "0", "-"]
    assert rows["local-2"] == ["restarting", "72", "3", "SIGKILL"]
    assert rows["local-3"] == ["given", "up", "73", "5", "exit", "1"]
    bare = io.StringIO()
    Console(width=80, file=bare).print(tables(pb.Status()))
    assert "local" not in bare.getvalue()


def test_the_status_and_the_log_tell_the_age_of_factors_and_its_bound():
    """The log as it is written: each step carries the bound that held then."""
    bodies = [bar(name=name, young=1e5, fixed="X < 0.01") for name in ("a", "b", "c")]
    sim = simulation(*bodies, gravity=(0, -9.81, 0), preconditioner="cholesky", schedule_rounds=2.0)
    found, logged = [], []
    link = SimpleNamespace(publish_status=found.append, wants_steps=lambda: False)
    recorder = SimpleNamespace(
        dropped=0, lost=0, failure="", behind=False,
        steps=lambda steps, block: logged.extend(pb.ObjectStep.FromString(step.data) for step in steps),
    )  # fmt: skip
    driver = Driver(sim)
    telemetry = Telemetry(driver, link, recorder, patient=False)  # type: ignore[arg-type]
    telemetry.publish_status("running")
    assert [(o.factor_age, o.factor_age_max, o.factor_age_bound) for o in found[0].objects] == [(-1, -1, -1)] * 3
    for _ in range(40):
        records = driver.advance(1)
        telemetry.records(records, messages.reactions(sim, driver.reactions, driver.other_reactions))
    telemetry.publish_status("running")
    bound = driver.age_bound()
    assert 0 < bound < 40
    for status, state in zip(found[1].objects, driver.bodies, strict=True):
        steps = [s for s in logged if s.header.object == status.object]
        assert status.factor_age == 40 - state.factors.newest > 0
        assert status.factor_age_max == max(s.factor_age for s in steps) <= bound == status.factor_age_bound
        assert {s.factor_age_bound for s in steps[:1]} == {-1} and steps[-1].factor_age_bound == bound


def test_the_client_shows_the_age_and_its_bound():
    text = io.StringIO()
    ages = {"liver": (12, 345), "beam": (0, -1)}
    last = pb.ObjectStep(preconditioner="block_jacobi")
    objects = [pb.ObjectStatus(object=o, last=last, factor_age=a, factor_age_bound=b) for o, (a, b) in ages.items()]
    Console(width=80, file=text).print(tables(pb.Status(objects=objects)))
    rows = {words[0]: words[-2:] for line in text.getvalue().splitlines() if (words := line.split())}
    assert (rows["liver"], rows["beam"]) == (["12/345", "block_jacobi"], ["0/-", "block_jacobi"])


def test_very_many_explicit_substeps_are_told_once_while_the_first_step_is_made():
    """A step of 1 s of a stiff cell takes hundreds of thousands: nobody waits for it without a word."""
    body = bar((1, 1, 1), (0.01, 0.01, 0.01), young=1e9, fixed="X < 1e-4")
    sim = simulation(body, dt=1.0, integrator={"scheme": "central_difference"})
    telemetry = Telemetry(Driver(sim), SimpleNamespace(), None, patient=False)  # type: ignore[arg-type]
    assert telemetry.warnings.many_substeps() == []  # not known yet
    step, told = Thread(target=sim.engine.run, args=(1,)), []
    step.start()
    while not told and step.is_alive():
        told = telemetry.warnings.many_substeps()
    assert sim.engine.step == 0, "told after the step"
    assert len(told) == 1 and f"{sim.engine.substeps:,} explicit substeps" in told[0]
    assert telemetry.warnings.many_substeps() == []
    sim.engine.loop.stop = 1
    step.join()
    assert sim.engine.records()["substeps"][0] == sim.engine.substeps > 100_000


def test_few_explicit_substeps_are_not_told():
    sim = simulation(bar(fixed="X < 0.01"), integrator={"scheme": "central_difference"})
    telemetry = Telemetry(Driver(sim), SimpleNamespace(), None, patient=False)  # type: ignore[arg-type]
    sim.engine.run(2)
    assert sim.engine.substeps > 0 and telemetry.warnings.many_substeps() == []


def test_energy_from_nowhere_is_told_once_though_the_body_hardly_moves():
    """A cube crushed by a cable, with one linearization a step: all is converged, and it springs to and fro."""
    case = next(case for case in EFFECT_CASES if case.name == "cable drawn in")
    table = {"name": "case", "dt": 0.01, **case.scene(np.random.default_rng(4))}
    sim = Simulation(
        Scene.model_validate(table | {"solver": {"preconditioner": "block_jacobi"}}, context={"folder": "."})
    )
    sim.engine.loop.energy_every = 1
    telemetry, told = Telemetry(Driver(sim), SimpleNamespace(), None, patient=False), []  # type: ignore[arg-type]
    for step in range(40):
        case.act(sim, step)
        sim.engine.run(1)
        records = sim.engine.records()
        told += [(step, line) for line in telemetry.warnings.gained_energy(records)]
        assert records["status"][0] == pb.CONVERGED
    assert len(told) == 1 and told[0][0] > 15 and "kinetic and elastic" in told[0][1]
