# SPDX-License-Identifier: MIT
"""Pressures of cavities and tensions of cables in the log, the status, exports and replays."""

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from clients.log.scalars import columns, row
from clients.watch import tables
from protocol import messages_pb2 as pb
from sim_server.recording import messages
from sim_server.replay.log import reaction_digests
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import INSIDE, TUBE, box, hollow
from tests.scenes import scene

PATH = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0]]
STEPS = 4


def three_bodies(folder: Path, **integrator: Any) -> Simulation:
    """One with a gas and a chamber of given pressure, one without anything, one with two cables."""
    chambers = [{"where": INSIDE, "amount": 1.1}, {"where": f"{INSIDE} and X > 0.3", "pressure": 30.0, "lids": True}]
    ropes = [{"path": PATH, "tension": 3.0}, {"path": PATH[::2], "stiffness": 1e3, "shortening": 0.01}]
    objects = [hollow(folder, chambers), hollow(folder, None), hollow(folder, None, cable=ropes)]
    for name, each in zip(("gas", "plain", "pulled"), objects, strict=True):
        each["name"] = name
        each["effects"]["fixed"] = {"where": "X < 0.01"}
    return Simulation(scene(*objects, gravity=(0, -9.81, 0), integrator=integrator))


@pytest.fixture(scope="module", params=["backward_euler", "central_difference"])
def told(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Logged steps, status, and what effects said of each step."""
    sim = three_bodies(tmp_path_factory.mktemp("bodies"), scheme=request.param)
    logged: list[pb.ObjectStep] = []
    statuses: list[pb.Status] = []
    link: Any = SimpleNamespace(publish_status=statuses.append, wants_steps=lambda: False)
    recorder: Any = SimpleNamespace(
        dropped=0, lost=0, failure="", behind=False,
        steps=lambda steps, block: logged.extend(pb.ObjectStep.FromString(step.data) for step in steps),
    )  # fmt: skip
    driver = Driver(sim)
    telemetry, expected = Telemetry(driver, link, recorder, patient=False), []
    for _ in range(STEPS):
        records = driver.advance(1)
        exerted = messages.reactions(sim, driver.reactions, driver.other_reactions)
        telemetry.records(records, exerted, messages.readings(sim, driver.readings))
        effects: Any = sim.effects
        gas, given = effects["cavity"].readings()
        rope, drawn = effects["cable"].readings()
        expected.append([gas.volume, gas.pressure, given.volume, given.pressure,
                         rope.tension, rope.length, drawn.tension, drawn.length])  # fmt: skip
    telemetry.publish_status("running")
    return SimpleNamespace(steps=logged, status=statuses[0], expected=np.array(expected))


def of(told: Any, name: str) -> list[pb.ObjectStep]:
    return [step for step in told.steps if step.header.object == name]


def test_every_step_in_the_log_tells_them_with_their_units(told: Any) -> None:
    first = of(told, "gas")[0].readings
    assert [(r.of, r.quantity, r.unit) for r in first] == [
        (f"cavity[{k}]", *each) for k in (0, 1) for each in (("volume", "m3"), ("pressure", "Pa"))
    ]
    found = [[r.value for name in ("gas", "pulled") for r in of(told, name)[k].readings] for k in range(STEPS)]
    assert (np.array(found) == told.expected).all()
    assert np.ptp(told.expected[:, [0, 1, 5, 6]], axis=0).min() > 0 and (told.expected[:, 3] == 30).all()
    assert not any(step.readings for step in of(told, "plain"))


def test_exports_have_a_column_of_each(told: Any) -> None:
    found = columns(map(row, of(told, "pulled")))
    readings = [name for name in found if name.startswith("reading/")]
    assert readings == [f"reading/cable[{k}]/{quantity}" for k in (0, 1) for quantity in ("tension", "length")]
    assert (np.stack([found[name] for name in readings], axis=1) == told.expected[:, 4:]).all()
    some = [*of(told, "pulled")[:2], pb.ObjectStep(header=pb.Header(object="pulled"), step=9)]
    assert np.isnan(columns(map(row, some))["reading/cable[0]/length"]).tolist() == [False, False, True]
    assert not any(name.startswith("reading/") for name in columns(map(row, of(told, "plain"))))


def test_the_status_and_watch_show_those_of_the_last_step(told: Any) -> None:
    assert [[r.value for r in o.last.readings] for o in told.status.objects] == [
        told.expected[-1, :4].tolist(), [], told.expected[-1, 4:].tolist()
    ]  # fmt: skip
    text = io.StringIO()
    Console(width=100, file=text).print(tables(told.status))
    lines = [" ".join(line.split()) for line in text.getvalue().splitlines()]
    volume, pressure = told.expected[-1, :2]
    assert f"gas cavity[0] volume {volume:.4g} m3, pressure {pressure:.4g} Pa" in lines
    assert any(line.startswith("pulled cable[1] tension ") for line in lines)


def test_a_replay_finds_another_reading(told: Any) -> None:
    now = pb.ObjectStep.FromString(of(told, "gas")[1].SerializeToString())
    assert set(reaction_digests(now)) == {"reading"} and reaction_digests(now) == reaction_digests(of(told, "gas")[1])
    now.readings[1].value = np.nextafter(now.readings[1].value, 1e9)
    assert reaction_digests(now) != reaction_digests(of(told, "gas")[1])


def test_scenes_without_them_have_nothing_of_it(tmp_path: Path) -> None:
    sim = Simulation(scene(hollow(tmp_path, None, box())))
    driver = Driver(sim)
    records = driver.advance(2)
    assert sim.measured == [] and sim.engine.readings.nbytes == 0
    assert not sim.engine.loop.readings and not sim.engine.loop.measured  # type: ignore[attr-defined]
    made = messages.steps(sim, records, readings=messages.readings(sim, driver.readings))
    assert not any(step.readings for step in made)


def test_one_that_is_no_list_has_no_number(tmp_path: Path) -> None:
    cup = hollow(tmp_path, {"where": TUBE, "pressure": 1.0, "lids": True}, box(opened=True))
    assert {m.of for m in Simulation(scene(cup)).measured} == {"cavity"}
