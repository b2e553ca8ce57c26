# SPDX-License-Identifier: MIT
"""Obstacles as clients see and move them: over the network, in logs, exports, tables and the viewer."""

from __future__ import annotations

import csv
import math
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from clients.client import Client
from clients.errors import BadInput
from clients.export.export import export
from clients.log.obstacles import Obstacle, Pose, obstacle_of
from clients.log.reader import Log
from clients.obstacle import turned
from clients.replay.player import Player
from clients.replay.timeline import Timeline
from clients.viewer import view
from clients.viewer.obstacle_surface import obstacle_surface
from clients.watch import tables
from protocol import messages_pb2 as pb
from protocol.refused import Refused
from sim_server.mesh import pose_matrix
from tests.clients.fake_server import FakeServer
from tests.clients.test_client import eventually
from tests.clients.test_command_line import run
from tests.clients.test_replay import FakeReplayServer
from tests.clients.test_view import Rrd
from tests.sample_contact import DT, HALF, MOVED, SHAPES, obstacle, pose, record_contact, touching_step

STEPS = 6


@pytest.fixture
def log(tmp_path: Path):
    with Log(record_contact(tmp_path / "run.mcap", STEPS)) as opened:
        yield opened


# --- over the network -------------------------------------------------------------------------------------------


@pytest.mark.system
def test_moves_are_sent_without_waiting_and_refusals_come_with_the_next() -> None:
    with FakeServer(obstacles=SHAPES) as server, Client(connect=[server.endpoint]) as client:
        tool = client.obstacle("tool")
        assert tool.shape.shape == "capsule" and tool.shape.size == (0.25, 2.0) and tool.shape.moved == "client"
        tool.move((0, 1, 2))
        tool.move((0, 1, 3), rotation=(HALF, 0, 0, HALF))
        tool.move((0, 1, 4), wait=True)
        assert eventually(lambda: len(server.commands) == 3)
        sent = sorted((c.target for c in server.commands), key=lambda target: target.position.z)
        assert {c.verb for c in server.commands} == {"move_obstacle"} and sent[0].obstacle == "tool"
        assert [t.HasField("rotation") for t in sent] == [False, True, False] and sent[1].rotation.z == HALF
        floor = client.obstacle("floor")
        with pytest.raises(BadInput, match="move_obstacle: obstacle 'floor' is fixed"):
            floor.move((0, 0, 0), wait=True)
        floor.move((0, 0, 0))

        def refused() -> bool:
            try:
                floor.move((0, 0, 0))
            except BadInput as error:
                return "'floor' is fixed" in str(error)
            return False

        assert eventually(refused)
        with pytest.raises(BadInput, match="no obstacle 'beam'; there is ball, block, bowl, floor, tool"):
            client.obstacle("beam")


@pytest.mark.system
def test_poses_and_scenes_without_obstacles() -> None:
    with FakeServer(obstacles=SHAPES) as server, Client(connect=[server.endpoint]) as client:
        poses = client.poses()
        found: list = []
        assert eventually(lambda: server.publish(4) or found.extend(poses.newest()) or len(found) >= 2)
        assert {frame.obstacle for frame in found} == set(MOVED)
        assert found[0].step == 4 and found[0].pose == Pose((0.0, -0.5, 0.0), (HALF, HALF, 0.0, 0.0))
    with FakeServer() as server, Client(connect=[server.endpoint]) as client:
        assert client.obstacles() == {} and client.poses().newest() == []
        with pytest.raises(BadInput, match="no obstacle 'tool'; there is none"):
            client.obstacle("tool")


@pytest.mark.system
def test_the_command() -> None:
    with FakeServer(obstacles=SHAPES) as server:
        given = ("--to", "0", "-0.2", "1", "--connect", server.endpoint)
        code, out, err = run("move-obstacle", "tool", *given)
        assert (code, err) == (0, "") and out == "tool goes to (0, -0.2, 1)\n"
        assert server.commands[-1].target.position.y == -0.2 and not server.commands[-1].target.HasField("rotation")
        code, out, _ = run("move-obstacle", "tool", *given, "--rotate", "0", "0", "90")
        assert code == 0 and server.commands[-1].target.rotation.z == pytest.approx(HALF)
        code, _, err = run("move-obstacle", "floor", *given)
        assert code == 2 and err == "sim-client: move_obstacle: obstacle 'floor' is fixed\n"


@pytest.mark.parametrize(
    ("position", "rotation", "said"),
    [
        ((0, 0), None, "position 0.0 0.0: allowed are three finite numbers"),
        ((0, math.nan, 0), None, "position 0.0 nan 0.0"),
        ((0, 0, 0), (1, 0, 0), "rotation 1.0 0.0 0.0: allowed are four"),
        ((0, 0, 0), (1, 1, 0, 0), "a quaternion w x y z of length 1"),
    ],
)
def test_moves_that_no_server_would_take(position: tuple, rotation: tuple | None, said: str) -> None:
    from clients.obstacle import Obstacle as Handle

    sent: list = []
    handle = Handle(type("Sender", (), {"send": sent.append, "command": sent.append})(), obstacle_of(obstacle("tool")))
    with pytest.raises(BadInput, match=said):
        handle.move(position, rotation)
    assert not sent


def test_angles_turn_as_those_of_scenes_do() -> None:
    for angles in np.random.default_rng(1).uniform(-360, 360, (20, 3)):
        np.testing.assert_allclose(Pose((0, 0, 0), turned(angles)).matrix(), pose_matrix(angles), atol=1e-14)


# --- messages ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shape": "torus"}, "a 'torus' of"),
        ({"size": [1.0]}, "a 'capsule' of"),
        ({"size": [1.0, math.nan]}, "nan"),
        ({"rotation": pb.Quaternion(w=1, x=1)}, "a quaternion of length 1"),
        ({"triangles": np.array([0, 1, 2], "<i4").tobytes()}, "triangles runs from 0 to 2"),
    ],
)
def test_malformed_obstacles_are_refused(change: dict, said: str) -> None:
    good = obstacle("tool")
    fields = {field.name: value for field, value in good.ListFields()} | change
    with pytest.raises(Refused, match=said):
        obstacle_of(pb.Obstacle(**fields))


# --- logs -------------------------------------------------------------------------------------------------------


def test_a_log_tells_obstacles_poses_and_contacts(log: Log) -> None:
    assert log.complete and log.notes == [] and set(log.objects) == {"beam"}
    assert set(log.obstacles) == set(SHAPES) and log.obstacles["block"].size == (1.0, 2.0, 3.0)
    assert len(log.obstacles["bowl"].triangles) == 6 and log.obstacles["floor"].moved == ""
    assert set(log.poses) == set(MOVED)
    assert [(p.step, p.pose.position[1]) for p in log.poses["tool"]] == [(s, -1 + s / 8) for s in range(STEPS + 1)]
    scalars = log.scalars("beam")
    assert scalars["contacts"].tolist() == [0, 0, 3, 4, 5, 6] and scalars["clipped"].tolist() == [0, 0, 0, 0, 1, 0]
    np.testing.assert_array_equal(scalars["contact_residual"], [np.nan, np.nan] + [0.125 / s for s in (3, 4, 5, 6)])
    assert scalars["status"].tolist()[-2:] == ["contact", "converged"]
    assert scalars["reaction/tool/force_z"].tolist() == [0, 0, 12, 16, 20, 24]
    assert scalars["reaction/floor/force_y"].tolist() == [0, 0, 0, 0, -7, 0]
    assert scalars["reaction/tool/torque_y"].tolist() == [0, 0, 0.5, 0.5, 0.5, 0.5]


def test_exports_have_the_reactions(log: Log, tmp_path: Path) -> None:
    export(log, "beam", tmp_path / "beam.csv")
    with (tmp_path / "beam.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["reaction/tool/force_z"]) for row in rows] == [0, 0, 12, 16, 20, 24]
    export(log, "beam", tmp_path / "beam.npz")
    with np.load(tmp_path / "beam.npz") as found:
        assert found["scalars/reaction/floor/force_y"].tolist() == [0, 0, 0, 0, -7, 0]


def test_a_replay_sends_obstacles_and_poses(log: Log) -> None:
    server = FakeReplayServer()
    with Timeline(log.path) as timeline:
        replay = Player(timeline, server, math.inf, begin=2 * DT)  # type: ignore[arg-type]
        replay.play()
    assert server.offered["obstacle", "bowl"] == obstacle("bowl") and ("obstacle", "floor") in server.offered
    assert [m for c, o, m in server.sent if (c, o) == ("pose", "tool")] == [
        pose("tool", s) for s in range(2, STEPS + 1)
    ]
    assert replay.states == STEPS - 1 and replay.steps == STEPS - 1
    status = server.offered["status", ""]
    assert isinstance(status, pb.Status) and status.objects[0].clipped == 1


# --- pictures and tables ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_surfaces_are_where_the_shape_says(name: str) -> None:
    shape = obstacle_of(obstacle(name))
    vertices, triangles = obstacle_surface(shape, np.array([-1.0, -2.0, 0.0]), np.array([3.0, 2.0, 4.0]))
    assert triangles.min() == 0 and triangles.max() == len(vertices) - 1
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if name == "ball":
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.5)
    elif name == "tool":
        axis = np.clip(vertices[:, 1], -1, 1)[:, None] * [0, 1, 0]
        np.testing.assert_allclose(np.linalg.norm(vertices - axis, axis=1), 0.25)
        np.testing.assert_allclose([low[1], high[1]], [-1.25, 1.25])
    elif name == "block":
        np.testing.assert_array_equal(high - low, [1, 2, 3])
    elif name == "floor":
        assert (vertices[:, 1] == 0).all()
        middle = shape.start.matrix() @ vertices.mean(axis=0) + shape.start.position
        np.testing.assert_allclose(
            middle[:2], [1, 0], atol=1e-12
        )  # this plane is z = 0, so below the middle in x and y
    if name in ("ball", "tool", "block"):
        assert _volume(vertices, triangles) == pytest.approx(_known_volume(shape), rel=0.03), "outward normals"


def _volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def _known_volume(shape: Obstacle) -> float:
    if shape.shape == "box":
        return math.prod(shape.size)
    radius, length = (*shape.size, 0.0)[:2]
    return math.pi * radius**2 * (4 / 3 * radius + length)


def test_the_viewer_gets_obstacles_poses_and_forces(log: Log, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    view.save_rrd(log, tmp_path / "run.rrd", "displacement")
    rrd = Rrd(tmp_path / "run.rrd")
    found = rrd.column("/world/tool", ":translation")
    assert [(step, float(at[0][1])) for step, _, at in found if step or at[0][1] > -1] == [
        (s, -1 + s / 8) for s in range(1, STEPS + 1)
    ]
    forces = [(step, float(v[0])) for step, _, v in rrd.column("/plots/reaction/beam\\ on\\ tool", "scalars")]
    assert forces == [(s, pytest.approx(math.hypot(3, 4 * s) if s >= 3 else 0)) for s in range(1, STEPS + 1)]
    contacts = [float(v[0]) for _, _, v in rrd.column("/plots/contacts/beam", "scalars")]
    assert contacts == [0, 0, 3, 4, 5, 6]


def test_a_picture_without_vulkan_shows_obstacles(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(view, "has_vulkan_driver", lambda: False)
    view.save_screenshot(log, tmp_path / "with.png", "displacement")
    log.obstacles.clear()
    view.save_screenshot(log, tmp_path / "without.png", "displacement")
    assert (tmp_path / "with.png").read_bytes() != (tmp_path / "without.png").read_bytes()


def shown(status: pb.Status) -> str:
    text = StringIO()
    Console(width=160, file=text).print(tables(status))
    return text.getvalue()


def test_watch_shows_contacts_only_with_obstacles() -> None:
    touched = pb.ObjectStatus(object="beam", last=touching_step("beam", 5), clipped=9, crowded=4)
    free = pb.ObjectStatus(object="liver", last=touching_step("liver", 1))
    assert "contact residual" not in shown(pb.Status(objects=[free]))
    held = pb.ObjectStatus(object="liver", last=touching_step("liver", 1))
    held.last.reactions.add(grab=7, force=pb.Vector(x=3.0, y=4.0))
    held.last.reactions.add(object="beam", force=pb.Vector(z=-2.0))
    assert "grab:7 5, beam 2" in shown(pb.Status(objects=[held]))
    text = shown(pb.Status(objects=[touched, free], obstacles=[pose("tool", 4)]))
    rows = [line.split() for line in text.splitlines()]
    assert ["beam", "5", "2", "2.5e-02", "9", "4", "tool", "20.2,", "floor", "7"] in rows
    assert ["liver", "0", "0", "-", "0", "0", "-"] in rows and ["tool", "0", "-0.5", "0", "90"] in rows
