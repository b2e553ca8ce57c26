# SPDX-License-Identifier: MIT
"""A log played as if its server were live: clients see what was recorded, under a name that is free."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.frames import mesh_of
from clients.replay.player import Player, speed_of
from clients.replay.replay_server import ReplayServer
from clients.replay.timeline import Timeline
from protocol import messages_pb2 as pb
from sim_server.recording.recorder import Recorder
from tests.clients.fake_server import FakeServer
from tests.ports import free_endpoint
from tests.sample_run import REST, TETS, header, object_step, positions, record, scene, topology, velocities
from tests.system.link_helpers import PATIENCE, ROOT
from tests.system.server_process import Process, run, tool, until

STEPS = 30
NAMES = ("beam", "liver")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return record(tmp_path / "run.mcap", STEPS, NAMES)


class FakeReplayServer:
    """Notes what a replay does."""

    def __init__(self) -> None:
        self.offered: dict[tuple[str, str], object] = {}
        self.sent: list[tuple[str, str, object]] = []
        self.asked: list[tuple[str, object]] = []
        self.replies: list[pb.Reply] = []

    def offer(self, channel: str, message: object, object: str = "") -> None:
        self.offered[channel, object] = type(message).FromString(message.SerializeToString())  # type: ignore[attr-defined]

    def put(self, channel: str, message: object, wait: bool = False, object: str = "") -> None:
        self.sent.append((channel, object, type(message).FromString(message.SerializeToString())))  # type: ignore[attr-defined]

    def commands(self) -> list[tuple[str, object]]:
        found, self.asked = self.asked, []
        return found

    def answer(self, query: object, reply: pb.Reply) -> None:
        self.replies.append(reply)

    def steps(self) -> list[tuple[str, int]]:
        return [(s.header.object, s.step) for c, _, m in self.sent if c == "steps" for s in m.steps]  # type: ignore[attr-defined]

    def states(self, name: str) -> list[int]:
        return [m.step for c, o, m in self.sent if c == "state" and o == name]  # type: ignore[attr-defined]


def played(log: Path, **options: float) -> FakeReplayServer:
    server = FakeReplayServer()
    with Timeline(log) as timeline:
        Player(timeline, server, math.inf, **options).play()  # type: ignore[arg-type]
    return server


def test_everything_is_sent_in_order(log: Path) -> None:
    server = played(log)
    assert sorted(server.steps()) == sorted((n, s) for n in NAMES for s in range(1, STEPS + 1))
    for name in NAMES:
        assert [s for n, s in server.steps() if n == name] == list(range(1, STEPS + 1))
        assert server.states(name) == list(range(STEPS + 1))
        assert server.offered["topology", name] == topology(name)
    states = [m for c, o, m in server.sent if (c, o) == ("state", "beam")]
    assert states[7].x == positions(7).tobytes() and states[7].v == velocities(7).tobytes()  # type: ignore[attr-defined]
    status = server.offered["status", ""]
    assert isinstance(status, pb.Status)
    assert (status.state, status.step, status.objects[1].last.iterations) == (
        "stopping", STEPS, object_step("liver", STEPS).iterations,
    )  # fmt: skip
    assert status.objects[0].nodes == 5 and status.objects[0].tets == 2


def test_a_part_is_sent_with_its_meshes(log: Path) -> None:
    server = played(log, begin=0.2, end=0.3)
    assert server.states("beam") == [10, 11, 12, 13, 14, 15]
    assert [s for n, s in server.steps() if n == "beam"] == [10, 11, 12, 13, 14, 15]
    assert ("topology", "liver") in server.offered
    with Timeline(log) as timeline, pytest.raises(BadInput, match=r"--from 9 .*holds 0 to 0\.6 s"):
        Player(timeline, FakeReplayServer(), 1.0, begin=9.0)  # type: ignore[arg-type]


def cut(number: int, removed: list[int]) -> pb.Topology:
    """As a log has it: only what the cut changes."""
    left = np.delete(TETS, removed, axis=0)[:, :3]
    parts = {"removed": np.array(removed, "<i4").tobytes(), "triangles": left.astype("<i4").tobytes()}
    return pb.Topology(header=header("beam"), nodes=len(REST), cut=number, **parts)


def test_cuts_of_a_log_are_whole_meshes_to_clients_and_events_are_counted(tmp_path: Path) -> None:
    """Of two elements one is removed from the start on, none from step 2 on, the other one from step 4 on."""
    whole = topology("beam")
    whole.skin_nodes, whole.skin_weights = TETS[:1].tobytes(), np.full(4, 0.25).tobytes()
    whole.skin_triangles = np.zeros(3, "<i4").tobytes()
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.scene(scene(["beam"]))
        for time_of, message in ((0.0, whole), (0.0, cut(1, [1])), (0.03, cut(2, [])), (0.07, cut(3, [0]))):
            recorder.topology(message, block=True, time=time_of)
        for step in range(1, 7):
            told = object_step("beam", step)
            told.fallbacks, told.halvings = 2 * (step > 4), int(step == 5)
            recorder.step(told, block=True)
    server = FakeReplayServer()
    with Timeline(tmp_path / "run.mcap") as timeline:
        player = Player(timeline, server, math.inf)  # type: ignore[arg-type]
        first = mesh_of(server.offered["topology", "beam"])  # type: ignore[arg-type]
        assert (first.epoch, first.tets.tolist()) == (2, TETS[:1].tolist()), "a client may connect at the start"
        for _ in range(3):  # as with --loop
            player.play()
    sent = [m for c, _, m in server.sent if c == "topology"]
    meshes = [mesh_of(m) for m in sent]  # type: ignore[arg-type]
    assert [mesh.epoch for mesh in meshes] == [1, 2, *[1, 2, 3, 4] * 3]
    assert [mesh.tets.tolist() for mesh in meshes[2:6]] == [
        TETS.tolist(),
        *(TETS[k].tolist() for k in ([0], [0, 1], [1])),
    ]
    assert [bool(m.skin_triangles) for m in sent[2:6]] == [True, False, False, False]  # type: ignore[attr-defined]
    status = server.offered["status", ""].objects[0]  # type: ignore[attr-defined]
    assert (status.nodes, status.tets) == (5, 1)
    assert {e.event: e.steps for e in status.events} == {"max_iterations": 1, "fallbacks": 2, "halvings": 1}


def test_a_cut_of_a_mesh_that_is_not_in_the_log_is_not_offered(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(cut(1, [1]))
    assert ("topology", "beam") not in played(tmp_path / "run.mcap").offered


def test_commands_pause_stop_and_are_refused(log: Path) -> None:
    server = FakeReplayServer()
    server.asked = [("push", None), ("pause", None), ("resume", None), ("stop", None)]
    with Timeline(log) as timeline:
        replay = Player(timeline, server, math.inf)  # type: ignore[arg-type]
        replay.play(loop=True)  # ends by the command alone
    assert ["push" in r.error for r in server.replies] == [True, False, False, False]
    assert replay.stopping and server.states("beam") == []


def test_a_log_cut_off_is_played_as_far_as_it_goes(log: Path, tmp_path: Path) -> None:
    whole = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    record(tmp_path / "long.mcap", 4000, ("beam",), "none")
    whole = (tmp_path / "long.mcap").read_bytes()
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    server = played(cut)
    sent = server.states("beam")
    assert 1000 < len(sent) < 4000 and sent == list(range(len(sent)))
    with Timeline(cut) as timeline:
        assert "without an end mark" in timeline.notes[0]
    cut.write_bytes(b"no log")
    with pytest.raises(BadInput, match="not an MCAP file"):
        Timeline(cut)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast", ""])
def test_bad_speeds(text: str) -> None:
    with pytest.raises(BadInput, match="--speed"):
        speed_of(text)
    assert speed_of("max") == math.inf and speed_of("0.5") == 0.5


def test_names() -> None:
    """A name that a live server has is refused if asked for, and gets a suffix if not."""
    with FakeServer() as server:
        with pytest.raises(ClientError, match=r"live server 'sim' is at .*--name"):
            ReplayServer("sim", "sim", [server.endpoint], None)
        with ReplayServer(None, "sim", [server.endpoint], None) as one:
            assert one.name == "sim-replay"
            with ReplayServer(None, "sim", [server.endpoint], None) as another:
                assert another.name == "sim-replay-2"
        with ReplayServer("mine", "sim", [server.endpoint], None) as named:
            assert named.name == "mine"
        with pytest.raises(BadInput, match="server name"):
            ReplayServer("no/name", "sim", [server.endpoint], None)


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def replay(log: Path, endpoint: str, tmp_path: Path) -> Iterator[Process]:
    process = Process(
        "clients", "replay", str(log), "--loop", "--speed", "0.5", "--listen", endpoint, log=tmp_path / "replay.log"
    )
    yield process
    process.end()


@pytest.mark.system
def test_a_client_sees_what_was_recorded(replay: Process, endpoint: str) -> None:
    """States and steps of a replay that begins again and again, bit for bit, until all were seen; then Ctrl-C."""
    client = connected(endpoint)
    with client:
        assert client.scene().name == "made-up.toml" and set(client.meshes()) == set(NAMES)
        np.testing.assert_array_equal(client.meshes()["beam"].rest, positions(0))
        states, steps = client.states(), client.steps()
        seen: set[tuple[str, int]] = set()
        solved: dict[tuple[str, int], int] = {}

        def everything() -> bool:
            for frame in states.newest():
                np.testing.assert_array_equal(frame.x, positions(frame.step))
                np.testing.assert_array_equal(frame.v, velocities(frame.step))
                seen.add((frame.object, frame.step))
            solved.update({(s.header.object, s.step): s.iterations for s in steps.new()})
            return len(seen) == 2 * (STEPS + 1) and len(solved) == 2 * STEPS

        until(everything, "all frames and steps are seen")
        assert solved == {(n, s): object_step(n, s).iterations for n in NAMES for s in range(1, STEPS + 1)}
        with pytest.raises(BadInput, match=r"replay of run\.mcap"):
            client.push("beam", (0, 0, 0), (1, 0, 0))
        client.pause()
        assert client.status().state == "paused"
        client.resume()
    assert run("clients", "watch", "--count", "1", "--connect", endpoint).returncode == 0
    assert replay.end(signal.SIGINT) == 130, replay.output()
    assert "Traceback" not in replay.output()


@pytest.mark.system
def test_beside_a_live_server(log: Path) -> None:
    """Through the live server's hub: refused under its name, played under another."""
    with FakeServer() as server:
        refused = run("clients", "replay", str(log), "--name", "sim", "--connect", server.endpoint)
        assert refused.returncode == 1 and "live server 'sim'" in refused.stderr and "Traceback" not in refused.stderr
        command = ["replay", str(log), "--connect", server.endpoint, "--speed", "max", "--json"]
        played = run("clients", *command)
        assert played.returncode == 0, played.stderr
        assert json.loads(played.stdout) == {"server": "sim-replay", "states": 62, "steps": 60}
        assert run("clients", *command, "--from", "3", "--to", "2").returncode == 2


def connected(endpoint: str) -> Client:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return Client(connect=[endpoint], timeout=2.0)
        except ClientError:
            if time.monotonic() > end:
                raise


def test_help_has_examples() -> None:
    shown = subprocess.run(tool("clients", "replay", "--help"), capture_output=True, text=True, cwd=ROOT, check=True)
    assert "--simulate" in shown.stdout and "Examples" in shown.stdout
