# SPDX-License-Identifier: MIT
"""Commands that move obstacles, what of contact goes into messages, and what is warned of, without a network."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.recording import messages
from sim_server.recording.obstacles import obstacle_messages, pose_messages, target_messages, targets_of
from sim_server.service.commands import Commands
from sim_server.service.telemetry import Telemetry
from sim_server.updates.driver import Driver
from tests.contact_scene import DT, FLOOR, PADDLE, contact_simulation
from tests.scenes import bar, simulation

HALF = 0.5**0.5


@pytest.fixture
def commands() -> Commands:
    return Commands(contact_simulation(), lambda interaction, time: None)


def move(commands: Commands, name: str = "tool", rotation: tuple | None = None, **position: float) -> str:
    turn = None if rotation is None else pb.Quaternion(**dict(zip("wxyz", rotation, strict=True)))
    target = pb.ObstacleTarget(obstacle=name, position=pb.Vector(**position), rotation=turn)
    return commands.carry_out(pb.Command(client="anna", verb="move_obstacle", target=target)).error


def pose(commands: Commands, name: str = "tool") -> pb.ObstaclePose:
    sim = commands.simulation
    return next(p for p in pose_messages(sim, sim.engine.step, fixed=True) if p.header.object == name)


def test_an_obstacle_goes_where_it_is_sent_at_its_speed(commands: Commands) -> None:
    assert move(commands, x=0.15, y=0.45, z=0.15) == ""
    engine = commands.simulation.engine
    engine.run(4)
    assert pose(commands).position.y == pytest.approx(0.5 - 4 * 0.5 * DT), "max_speed = 0.5 m/s"
    assert (pose(commands).step, pose(commands).time) == (4, pytest.approx(4 * DT))
    engine.run(20)
    assert pose(commands).position.y == 0.45 and pose(commands).rotation.w == pytest.approx(HALF), "not turned"
    assert move(commands, rotation=(1, 0, 0, 0), x=0.15, y=0.45, z=0.15) == ""
    assert move(commands, y=0.46) == ""
    assert commands.simulation.contact is not None
    assert commands.simulation.contact.targets["tool"].tolist() == [0, 0.46, 0, 1, 0, 0, 0], "turned as it was to be"


@pytest.mark.parametrize(
    ("name", "rotation", "position", "said"),
    [
        ("spoon", None, {}, "no obstacle 'spoon'"),
        ("floor", None, {}, "obstacle 'floor' is not moved by clients"),
        ("paddle", (1, 0, 0, 0), {}, "obstacle 'paddle' is not moved by clients"),
        ("tool", (1, 0, 0, 1e-2), {}, "must be a quaternion of length 1"),
        ("tool", (0, 0, 0, 0), {}, "must be a quaternion of length 1"),
        ("tool", (np.nan, 0, 0, 0), {}, "must be a quaternion of length 1"),
        ("tool", None, {"x": np.nan}, "must be finite numbers"),
        ("tool", None, {"x": 1e300}, "1000 times its size"),
    ],
)
def test_bad_moves_are_refused(commands: Commands, name: str, rotation: tuple, position: dict, said: str) -> None:
    assert commands.simulation.contact is not None
    before = commands.simulation.contact.targets["tool"]
    assert said in move(commands, name, rotation, **position)
    np.testing.assert_array_equal(commands.simulation.contact.targets["tool"], before)


def test_a_rotation_that_was_rounded_is_made_a_unit(commands: Commands) -> None:
    assert move(commands, rotation=(0.7071068, 0, 0, 0.7071068)) == ""
    assert commands.simulation.contact is not None
    assert np.linalg.norm(commands.simulation.contact.targets["tool"][3:]) == pytest.approx(1, abs=1e-15)


def test_a_scene_without_contact_says_so() -> None:
    commands = Commands(simulation(bar(fixed="X < 0.01")), lambda interaction, time: None)
    assert move(commands) == "the scene does not list the effect contact, so it has no obstacles, and no holders"
    assert obstacle_messages(commands.simulation) == [] and pose_messages(commands.simulation, 0, fixed=True) == []
    assert not messages.scene(commands.simulation).obstacles


def test_obstacles_as_messages(commands: Commands) -> None:
    floor, tool, paddle = obstacle_messages(commands.simulation)
    assert list(messages.scene(commands.simulation).obstacles) == ["floor", "tool", "paddle"]
    assert (floor.shape, list(floor.size), floor.moved) == ("plane", [], "") and floor.rotation.w == 1
    assert (tool.shape, list(tool.size), tool.moved) == ("capsule", [0.05, 0.2], "client")
    assert tool.rotation.w == pytest.approx(HALF) and tool.rotation.z == pytest.approx(HALF)
    assert (paddle.shape, list(paddle.size), paddle.moved) == ("box", [0.1, 0.4, 0.4], "keyframes")
    assert paddle.position == pb.Vector(x=1, y=0.2, z=0.15)
    assert [p.header.object for p in pose_messages(commands.simulation, 0)] == ["tool", "paddle"], "what moves"


def test_poses_on_keyframes_are_those_of_the_loop() -> None:
    """At the time that is asked for, whatever the loop has come to."""
    frames = [(0.02, [10, 200, 30], [0, 0, 0]), (0.05, [190, 20, -50], [1, 2, 3]), (0.07, [0, 0, 0], [0, 1, 0])]
    paddle = PADDLE | {"keyframes": [{"time": t, "rotate": r, "translate": x} for t, r, x in frames]}
    sim = contact_simulation(FLOOR, paddle)
    assert sim.contact is not None
    loop = []
    for _ in range(9):
        sim.engine.run(1)
        loop.append(sim.contact.contact_input().obstacles.end[1].copy())
    for step, pose in enumerate(loop, 1):
        (found,) = pose_messages(sim, step)
        p, q = found.position, found.rotation
        np.testing.assert_allclose([p.x, p.y, p.z], pose[:3], atol=1e-14)
        rotation = np.array([q.w, q.x, q.y, q.z])
        np.testing.assert_allclose(rotation * np.sign(rotation @ pose[3:]), pose[3:], atol=1e-14)
        assert (found.step, found.time) == (step, step * DT)


def test_targets_come_back_bit_for_bit() -> None:
    targets = {"tool": np.random.default_rng(3).normal(size=7), "spoon": np.zeros(7)}
    again = targets_of(pb.ObstacleTargets.FromString(target_messages(5, targets).SerializeToString()))
    assert again.keys() == targets.keys() and all(again[k].tobytes() == targets[k].tobytes() for k in targets)


def test_steps_tell_contacts_and_reactions(commands: Commands) -> None:
    sim = commands.simulation
    sim.engine.run(80)
    records, on_obstacles = sim.engine.records_and_reactions()
    steps = messages.steps(sim, records, reactions=messages.reactions(sim, on_obstacles, sim.engine.other_reactions()))
    free, resting = steps[0], steps[-1]
    assert not free.HasField("contact_residual") and (free.contacts, free.passes, len(free.reactions)) == (0, 0, 0)
    assert resting.contacts == 16 and resting.passes > 0 and resting.contact_residual <= 1e-3
    (reaction,) = resting.reactions
    weight = 9.81 * sim.world.mass.sum()
    assert reaction.obstacle == "floor" and reaction.force.y == pytest.approx(-weight, rel=0.05)
    middle = sim.fetch().x.mean(axis=0)
    assert reaction.torque.z == pytest.approx(-weight * middle[0], rel=0.05), "about the floor's own origin"


def test_bodies_that_touch_nothing_log_the_same_bytes_as_ever() -> None:
    sim = simulation(bar(fixed="X < 0.01"))
    sim.engine.run(1)
    (step,) = messages.steps(sim, *[sim.engine.records()])
    fields = {field.name for field, _ in step.ListFields()}
    assert not fields & {"contacts", "passes", "clipped", "contact_residual", "reactions"}


def test_what_contact_leaves_undone_is_said_once_for_each_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_server.service.contact_telemetry.ROWS_PERIOD", 0.0)
    sim = contact_simulation()
    link: Any = SimpleNamespace(dispatch=None)
    telemetry = Telemetry(Driver(sim), link, None, patient=False)
    sim.engine.run(3)
    records, _ = sim.engine.records_and_reactions()
    assert telemetry.contact.count_clipped(records) == [] and telemetry.contact.crowded_nodes() == []
    records["clipped"][1:] = 2, 5
    (line,) = telemetry.contact.count_clipped(records)
    assert line.startswith("object 'cube', step 2: 2 nodes would have passed into an obstacle")
    assert telemetry.contact.count_clipped(records) == [] and telemetry.contact.clipped[0] == 14
    records["status"][2], records["contact_residual"][2] = pb.CONTACT, 0.25
    assert "not converged (contact, residual 2.5e-01)" in telemetry.warnings.count_unconverged(records)[0]
    assert sim.contact is not None
    sim.contact.dropped[7:9] = 1, 4
    assert "more obstacles or objects near" in telemetry.contact.crowded_nodes()[0]
    assert telemetry.contact.crowded_nodes() == [] and telemetry.contact.crowded == {0: 5}
    statuses: list[pb.Status] = []
    link.publish_status = statuses.append
    telemetry.publish_status("running")
    assert [found.crowded for found in statuses[0].objects] == [5]


def test_matrices_for_factors_made_in_the_step_know_contacts() -> None:
    """They are those that workers are sent: with the stiffness of rows that carry force."""
    sim = contact_simulation()
    sim.engine.run(60)
    before = sim.system.body_values(0, sim.world.nodes).copy()
    sim.engine.assemble()
    added = sim.engine.factor_matrix(0) - sim.system.body_values(0, sim.world.nodes)
    assert not np.array_equal(before, sim.system.body_values(0, sim.world.nodes))
    blocks = np.flatnonzero(np.abs(added).max(axis=(1, 2)) > 0)
    assert len(blocks) == 16, "nodes on the floor"
    assert (np.linalg.eigvalsh(added[blocks]) > -1e-9 * np.abs(added).max()).all()
    sim.engine.solve()
    without = simulation(bar(fixed="X < 0.01"))
    without.engine.assemble()
    assert np.array_equal(without.engine.factor_matrix(0), without.system.body_values(0, without.world.nodes))
