# SPDX-License-Identifier: MIT
"""Forces of grabs, obstacles and pairs of bodies, from real processes: in the log, and on the channel of each step."""

import json
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from clients.errors import BadInput, ClientError
from clients.log.reader import Log
from clients.subscriptions import Steps
from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL, key
from protocol.network.session import open_session
from tests.system.server_process import Stage, run, until
from tests.system.test_replay_of_a_server import CPU
from tests.system.test_replay_of_a_server import messages as logged

pytestmark = pytest.mark.system
DT = 0.01
SCENE = f"""
dt = {DT}
[effects]
gravity = {{ g = [0, -9.81, 0] }}
contact = {{ thickness = 0.002 }}
[solver]
tolerance = 1e-10
[[object]]
name = "upper"
mesh = {{ bar = [2, 2, 2], size = [0.1, 0.1, 0.1], split = "kuhn" }}
pose = {{ translate = [0, 0.102, 0] }}
[object.effects]
corotational = {{ young = 1e5, poisson = 0.4 }}
rayleigh = {{ mass = 5 }}
touch = {{ max_force = 100 }}
[[object]]
name = "lower"
mesh = {{ bar = [2, 2, 2], size = [0.1, 0.1, 0.1], split = "kuhn" }}
pose = {{ translate = [0.001, 0.001, 0.0] }}
[object.effects]
corotational = {{ young = 1e5, poisson = 0.4 }}
rayleigh = {{ mass = 5 }}
[[obstacle]]
name = "floor"
shape = "plane"
[[obstacle]]
name = "tool"
shape = "sphere"
radius = 0.03
moved = "client"
max_speed = 0.2
pose = {{ translate = [0.05, 0.3, 0.05] }}
"""
WEIGHT = 9.81  # N, of each cube: 1 kg


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    yield made
    made.close()


def by_name(step: pb.ObjectStep, kind: str) -> dict[str | int, pb.Reaction]:
    return {getattr(r, kind): r for r in step.reactions if r.WhichOneof("on") == kind}


def vector(v: pb.Vector) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def test_forces_of_a_grab_are_the_springs_law_and_those_of_pairs_are_contrary(stage: Stage, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    server = stage.server(tmp_path / "scene.toml", "--record", str(log), *CPU)
    with stage.client() as client:
        with client.grab("upper", at=(0.05, 0.202, 0.05), radius=0.08, stiffness=500, max_force=50) as held:
            for k in range(20):
                held.move((0.05 + 0.001 * k, 0.21, 0.05), wait=k % 2 == 0)
            assert held.force != (0, 0, 0) and 0.1 < held.point[1] < 0.3
            step = client.status(fresh=True).step
            until(lambda: client.status(fresh=True).step > step + 20, "it is held for a while")
        step = client.status(fresh=True).step
        until(lambda: client.status(fresh=True).step > step + 60, "they lie on each other")
        on_lower = client.contact_force("upper", "lower")
        assert on_lower.step > 0 and on_lower.force[1] < 0
        assert client.obstacle("floor").force[1] == pytest.approx(-2 * WEIGHT, rel=0.5)
        client.stop()
    assert server.wait() == 0, server.output()
    steps = {(s.header.object, s.step): s for s in logged(log, "step")}
    sets = logged(log, "touch")
    checked = 0
    with Log(log) as opened:
        frames = {frame.step: frame for frame in opened.frames("upper")}
        nodes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for s in sets:
            for i in s.interactions:
                if i.held:
                    nodes[i.id] = np.frombuffer(i.held, "<i4"), np.frombuffer(i.offsets, "<f8").reshape(-1, 3)
        for (name, number), step_message in steps.items():
            if name != "upper":
                continue
            grabs = by_name(step_message, "grab")
            acting = next((s for s in reversed(sets) if s.step < number), None)
            assert set(grabs) == {i.id for i in (acting.interactions if acting else [])}
            for id, reaction in grabs.items():
                wanted = next(i for i in acting.interactions if i.id == id)
                held_nodes, offsets = nodes[id]
                x = frames[number].x[held_nodes]
                pulls = wanted.stiffness / len(held_nodes) * (vector(wanted.target) + offsets - x)
                np.testing.assert_allclose(-vector(reaction.force), pulls.sum(axis=0), atol=1e-9 * wanted.stiffness)
                np.testing.assert_allclose(vector(reaction.point), (x - offsets).mean(axis=0), atol=1e-12)
                moment = np.cross(x - vector(reaction.point), -pulls).sum(axis=0)
                np.testing.assert_allclose(vector(reaction.torque), moment, atol=1e-9)
                checked += 1
    assert checked > 20
    pairs = 0
    for number in {n for _, n in steps}:
        one, other = by_name(steps["upper", number], "object"), by_name(steps["lower", number], "object")
        assert set(one) <= {"lower"} and (set(other) == {"upper"}) == (set(one) == {"lower"})
        for r in one.values():
            back = other["upper"]
            assert (vector(r.force) == -vector(back.force)).all() and (vector(r.torque) == -vector(back.torque)).all()
            assert r.point == back.point and 0.09 < r.point.y < 0.11
            pairs += 1
    assert pairs > 50
    out = tmp_path / "upper.csv"
    assert run("clients", "export", str(log), "--object", "upper", "--to", str(out)).returncode == 0
    heading = out.read_text().splitlines()[0].split(",")
    assert {"reaction/grab:1/point_y", "reaction/grab:1/force_x", "reaction/lower/torque_z"} <= set(heading)
    result = run("clients", "replay", str(log), "--simulate", "--json")
    assert json.loads(result.stdout)["same"], result.stdout


def test_a_hanging_body_pulls_with_its_weight(stage: Stage, tmp_path: Path) -> None:
    stage.server(tmp_path / "scene.toml", *CPU)
    with stage.client() as client:
        with client.grab("upper", (0.05, 0.202, 0.05), (0.05, 0.24, 0.05), 0.08, stiffness=2000, max_force=60) as held:
            weight, looks = np.array([0, WEIGHT, 0]), deque([False], maxlen=10)

            def hangs() -> bool:
                right = np.abs(np.array(held.force) - weight).max() < 1e-3 * WEIGHT
                looks.append(right and held.point[1] == pytest.approx(0.24 - WEIGHT / 2000, abs=1e-5))
                return len(looks) == 10 and all(looks)

            until(hangs, "it hangs still, as low as the spring lets it")
        with pytest.raises(ClientError, match="released"):
            _ = held.force
        client.pause()

        def silent() -> bool:
            listener = client.listen(None)
            try:
                listener.obstacle("floor", 0.3)
            except ClientError as error:
                return "no step with forces" in str(error)
            finally:
                listener.close()
            return False

        until(silent, "the last steps before the pause have come, and none comes after them")


def test_every_step_comes_to_who_reads_and_losses_are_told_to_who_does_not(stage: Stage, tmp_path: Path) -> None:
    stage.server(tmp_path / "scene.toml", "--set", "dt=0.004", *CPU)
    with stage.client() as client, open_session("client", connect=[stage.endpoint], shared_memory=False) as other:
        reader = client.reactions()
        batches: list[pb.Steps] = []
        listener = client.listen(lambda batch, now: batches.append(batch))
        found: list[pb.ObjectStep] = []
        until(lambda: found.extend(reader.new()) or len(found) > 400, "steps")
        assert reader.lost == 0 and listener.lost == 0
        for name in ("upper", "lower"):
            steps = [s.step for s in found if s.header.object == name]
            assert steps == list(range(steps[0], steps[-1] + 1))
        assert all(not s.iterations and not s.preconditioner for s in found)
        lazy = Steps(other.zenoh, client.name, "reactions", batches=4)
        count = len(batches)
        until(lambda: len(batches) > count + 30, "messages that nobody reads")
        assert len({s.step for s in lazy.new()}) >= 4
        count = len(batches)
        until(lambda: len(batches) > count + 30, "messages that nobody reads")
        lazy.new()
        assert lazy.lost >= 20


def test_nothing_is_sent_unless_somebody_asks(stage: Stage, tmp_path: Path) -> None:
    """A subscriber of all other channels sees none of this one until somebody subscribes to it; then moves are told."""
    stage.server(tmp_path / "scene.toml", *CPU)
    with stage.client() as client:
        with pytest.raises(BadInput, match="obstacle"):
            client.obstacle("spoon")
        tool = client.obstacle("tool")
        numbers = [tool.move((0.05, 0.28, 0.05)), tool.move((0.05, 0.27, 0.05))]
        until(lambda: client.status(fresh=True).step > 50, "it runs")
        batches: list[pb.Steps] = []
        listener = client.listen(lambda batch, now: batches.append(batch))
        until(lambda: batches, "a message")
        assert batches[0].header.sequence == 1 and not batches[0].moves
        sent = tool.move((0.05, 0.25, 0.05))
        until(lambda: any(batch.moves for batch in batches), "the move was taken up")
        (move,) = next(batch.moves for batch in batches if batch.moves)
        assert (move.client, move.obstacle, move.move) == (client.id, "tool", sent) and sent > max(numbers)
        newest = max(step.step for batch in batches for step in batch.steps)
        assert 50 < move.step <= newest
        listener.close()


def test_malformed_messages_on_the_channel_are_left_out(stage: Stage, tmp_path: Path) -> None:
    stage.server(tmp_path / "scene.toml", *CPU)
    with stage.client() as client, open_session("client", connect=[stage.endpoint], shared_memory=False) as evil:
        forces = client.forces
        until(lambda: client.obstacle("floor").force[1] < 0, "the cubes stand on the floor")
        own = client.status().header.incarnation
        sent = [b"\xff" * 50, b"", b"\0" * (2 << 20)]
        for incarnation, force in ((own, float("nan")), (own + 1, 1e6), (0, 1e6)):
            header = pb.Header(protocol=PROTOCOL, incarnation=incarnation)
            bad = pb.Steps(header=header, steps=[pb.ObjectStep(header=pb.Header(object="lower"), step=1 << 60)])
            bad.steps[0].reactions.add(obstacle="floor", force=pb.Vector(y=force))
            sent.append(bad.SerializeToString())
        for data in sent:
            evil.zenoh.put(key("reactions", client.name), data, congestion_control=zenoh.CongestionControl.BLOCK)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert -100 < client.obstacle("floor").force[1] < 0
        assert forces.obstacle("floor", 1.0).step < 1 << 50


def test_a_scripted_hand_feels_the_cube(stage: Stage, tmp_path: Path) -> None:
    stage.server(tmp_path / "scene.toml", *CPU)
    with stage.client():
        result = run(
            "clients", "haptics", "tool", "--press", "0", "-0.09", "0", "--rate", "0.5", "--seconds", "4",
            "--connect", stage.endpoint, "--json",
        )  # fmt: skip
        assert result.returncode == 0, result.stdout + result.stderr
        found = json.loads(result.stdout)
        assert found["most_felt"] > 0.5 and found["steps"] > 20
        assert 0 < found["moves"] <= found["periods"] and found["steps_late_p50"] >= 1 and found["ms_p50"] > 0
        still = ("--press", "0", "0", "0", "--connect", stage.endpoint)
        wrong = run("clients", "haptics", "tool", "--stiffness", "1e5", *still)
        assert wrong.returncode == 2 and "without giving off energy" in wrong.stderr
        wrong = run("clients", "haptics", "floor", *still)
        assert wrong.returncode == 2 and "not moved by clients" in wrong.stderr
