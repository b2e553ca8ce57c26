# SPDX-License-Identifier: MIT
"""Foxglove: files read by mcap's own reader with the schemas that they carry, and the bridge by a plain WebSocket."""

from __future__ import annotations

import base64
import json
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.export.export import export
from clients.export.foxglove_live import serve, write_layout
from clients.log.reader import Log
from sim_server.recording.recorder import Recorder
from tests.clients.fake_server import FakeServer
from tests.ports import free_port
from tests.sample_contact import record_contact
from tests.sample_run import DT, REST, TRIANGLES, object_step, positions, record, scene, state, topology

STEPS = 6
START = 1_700_000_000_000_000_000  # ns


def decoded(path: Path) -> dict[str, list[tuple[int, str, Any]]]:
    """By topic: (time [ns], name of the schema, message) in the order of time."""
    found: dict[str, list[tuple[int, str, Any]]] = {}
    with path.open("rb") as stream:
        for schema, channel, message, body in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema is not None and channel.message_encoding == schema.encoding == "protobuf"
            found.setdefault(channel.topic, []).append((message.log_time, schema.name, body))
    return found


def started(path: Path) -> Path:
    """A log of two objects that began at a known time."""
    with Recorder(path) as recorder:
        found = scene(["beam", "liver"])
        found.started_ns = START
        recorder.scene(found)
        for name in ("beam", "liver"):
            recorder.topology(topology(name))
        for step in range(STEPS + 1):
            for name in ("beam", "liver"):
                if step:
                    recorder.step(object_step(name, step), block=True)
                recorder.state(state(name, step), block=True)
    return path


def corners(entity: Any) -> tuple[np.ndarray, np.ndarray]:
    (triangles,) = entity.triangles
    return np.array([(p.x, p.y, p.z) for p in triangles.points]), np.array(triangles.indices).reshape(-1, 3)


def test_a_file_has_surfaces_nodes_and_scalars_at_wall_clock_times(tmp_path: Path) -> None:
    with Log(started(tmp_path / "run.mcap")) as log:
        written = export(log, None, tmp_path / "run.foxglove.mcap")
    assert set(written) == {tmp_path / "run.foxglove.mcap", tmp_path / "run.layout.json"}
    found = decoded(tmp_path / "run.foxglove.mcap")
    times = [START + round(step * DT * 1e9) for step in range(STEPS + 1)]
    bodies = found["/bodies"]
    assert {name for _, name, _ in bodies} == {"foxglove.SceneUpdate"}
    for name in ("beam", "liver"):
        entities = [(at, e) for at, _, update in bodies for e in update.entities if e.id == name]
        assert [at for at, _ in entities] == times
        for step, (at, entity) in enumerate(entities):
            points, triangles = corners(entity)
            np.testing.assert_allclose(points, positions(step), rtol=1e-6)
            np.testing.assert_array_equal(triangles, TRIANGLES)
            assert entity.frame_id == "scene" and entity.timestamp.ToNanoseconds() == at
            assert len(entity.triangles[0].colors) == len(points)
        clouds = found[f"/nodes/{name}"]
        assert [at for at, _, _ in clouds] == times
        cloud = clouds[4][2]
        values = np.frombuffer(cloud.data, "<f4").reshape(-1, cloud.point_stride // 4)
        columns = {field.name: values[:, field.offset // 4] for field in cloud.fields}
        np.testing.assert_array_equal(np.stack([columns[k] for k in "xyz"], 1), positions(4).astype("f4"))
        np.testing.assert_allclose(columns["displacement"], np.linalg.norm(positions(4) - REST, axis=1), atol=1e-7)
        np.testing.assert_allclose(columns["speed"], 4 / 8 * 3**0.5, rtol=1e-6)
        steps = found[f"/step/{name}"]
        assert [at for at, _, _ in steps] == times[1:] and {schema for _, schema, _ in steps} == {
            "warpfactor.ObjectStep"
        }
        assert [m.kinetic_energy for _, _, m in steps[1:]] == [10.0 * k for k in range(2, STEPS + 1)]
        assert [m.iterations for _, _, m in steps] == [object_step(name, k).iterations for k in range(1, STEPS + 1)]
    assert len(found["/frames"]) == 1 and found["/frames"][0][2].child_frame_id == "scene"


def test_a_log_itself_has_energies_that_plain_readers_decode(tmp_path: Path) -> None:
    """Without an export: the schema in the log is enough to plot scalars of steps."""
    steps = decoded(started(tmp_path / "run.mcap"))["/step/beam"]
    assert [m.kinetic_energy for _, _, m in steps[1:]] == [10.0 * k for k in range(2, STEPS + 1)]
    assert [m.HasField("elastic_energy") for _, _, m in steps] == [k % 3 == 0 for k in range(1, STEPS + 1)]


def test_reactions_have_channels_and_obstacles_move(tmp_path: Path) -> None:
    with Log(record_contact(tmp_path / "run.mcap", STEPS)) as log:
        export(log, "beam", tmp_path / "run.foxglove.mcap")
    found = decoded(tmp_path / "run.foxglove.mcap")
    tool = found["/reaction/beam/tool"]
    assert [(m.force.x, m.force.z) for _, _, m in tool] == [(3.0, 4.0 * step) for step in range(3, STEPS + 1)]
    assert {schema for _, schema, _ in tool} == {"warpfactor.Reaction"}
    assert [m.force.y for _, _, m in found["/reaction/beam/floor"]] == [-7.0]
    plan = json.loads((tmp_path / "run.layout.json").read_text())["configById"]
    assert [p["value"] for p in plan["Plot!forces"]["paths"]][-1] == "/reaction/beam/tool.force.z"
    assert "Plot!readings" not in plan
    solids = [(at, e) for at, _, update in found["/obstacles"] for e in update.entities]
    assert {e.id for _, e in solids} == {"floor", "ball", "block", "tool", "bowl"}
    heights = [(at, e.triangles[0].pose.position.y) for at, e in solids if e.id == "tool"][1:]
    assert heights == [(round(step * DT * 1e9), -1 + step / 8) for step in range(STEPS + 1)]


def test_readings_have_channels(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.topology(topology("beam"))
        recorder.state(state("beam", 0), block=True)
        for step in (1, 2):
            message = object_step("beam", step)
            message.readings.add(of="cavity[1]", quantity="pressure", value=5.0 * step)
            recorder.step(message, block=True)
    with Log(tmp_path / "run.mcap") as log:
        export(log, None, tmp_path / "out.mcap")
    found = decoded(tmp_path / "out.mcap")["/reading/beam/cavity[1]/pressure"]
    assert [(name, m.value) for _, name, m in found] == [("warpfactor.Reading", 5.0), ("warpfactor.Reading", 10.0)]
    (path,) = json.loads((tmp_path / "out.layout.json").read_text())["configById"]["Plot!readings"]["paths"]
    assert path["value"] == '"/reading/beam/cavity[1]/pressure".value'


def test_the_layout_names_topics_of_the_file(tmp_path: Path) -> None:
    with Log(started(tmp_path / "run.mcap")) as log:
        export(log, None, tmp_path / "run.foxglove.mcap")
    topics = decoded(tmp_path / "run.foxglove.mcap")
    plan = json.loads((tmp_path / "run.layout.json").read_text())
    panels = plan["configById"]

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(plan["layout"])) == sorted(panels)
    view = panels["3D!bodies"]["topics"]
    assert set(view) - {"/obstacles"} == {"/bodies", "/nodes/beam", "/nodes/liver"} <= set(topics)
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    assert "/step/beam.kinetic_energy" in paths and "/step/liver.residual" in paths
    for path in paths:
        topic, field = path.split(".")
        assert hasattr(topics[topic][0][2], field), path


def test_frames_that_are_not_finite_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = state("beam", 1)
    broken.x = np.full((5, 3), np.nan).tobytes()
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.topology(topology("beam"))
        for message in (state("beam", 0), broken, state("beam", 2)):
            recorder.state(message, block=True)
    with Log(tmp_path / "run.mcap") as log:
        export(log, None, tmp_path / "out.mcap")
    assert "1 frames with NaN or infinite positions are left out" in capsys.readouterr().err
    assert [at for at, _, _ in decoded(tmp_path / "out.mcap")["/bodies"]] == [0, round(2 * DT * 1e9)]


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with Log(record(tmp_path / "run.mcap", 1)) as log:
        with pytest.raises(BadInput, match=r"this is the log itself; allowed: another file"):
            export(log, None, tmp_path / "run.mcap")
        with pytest.raises(ClientError, match="cannot be written: No such file"):
            export(log, None, tmp_path / "missing" / "x.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


class Bridge:
    """What the protocol of Foxglove tells a program that connects: channels, and messages of those subscribed to."""

    def __init__(self, port: int) -> None:
        client = pytest.importorskip("websockets.sync.client")
        self._socket = client.connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], open_timeout=20)
        self._channels: dict[int, dict[str, Any]] = {}
        self.asked: dict[int, int] = {}  # subscription -> channel

    def take(self, topics: set[str], count: int) -> dict[str, list[Any]]:
        """Subscribes to topics as they are advertised, and returns at least `count` messages of each."""
        found: dict[str, list[Any]] = {topic: [] for topic in topics}
        end = time.monotonic() + 60
        while min(map(len, found.values())) < count:
            assert time.monotonic() < end, {topic: len(messages) for topic, messages in found.items()}
            data = self._socket.recv(timeout=20)
            if isinstance(data, str):
                self._note(json.loads(data), topics)
            elif data[0] == 1:  # MessageData: subscription, time, body
                subscription, _ = struct.unpack_from("<IQ", data, 1)
                channel = self._channels[self.asked[subscription]]
                found[channel["topic"]].append(self._decode(channel, data[13:]))
        return found

    def _note(self, message: dict[str, Any], topics: set[str]) -> None:
        if message["op"] != "advertise":
            return
        for channel in message["channels"]:
            self._channels[channel["id"]] = channel
            if channel["topic"] in topics:
                number = len(self.asked) + 1
                self.asked[number] = channel["id"]
                wanted = [{"id": number, "channelId": channel["id"]}]
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    @staticmethod
    def _decode(channel: dict[str, Any], body: bytes) -> Any:
        pool = DescriptorPool()
        waiting = list(FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file)
        while waiting:
            file = next(f for f in waiting if not {d for d in f.dependency} & {w.name for w in waiting})
            pool.Add(file)
            waiting.remove(file)
        return GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString(body)

    def close(self) -> None:
        self._socket.close()


@pytest.mark.system
def test_the_bridge_follows_a_server(tmp_path: Path) -> None:
    port, ready, end = free_port(), threading.Event(), threading.Event()
    with FakeServer(obstacles=("tool", "floor")) as server, Client(connect=[server.endpoint]) as client:
        thread = threading.Thread(
            target=serve, args=(client, "127.0.0.1", port, lambda _: ready.set(), lambda: not end.is_set())
        )
        thread.start()
        stop = threading.Event()

        def publish() -> None:
            step = 1
            while not stop.wait(0.05):
                server.publish(step := step % 50 + 1)

        publisher = threading.Thread(target=publish)
        publisher.start()
        try:
            assert ready.wait(20)
            bridge = Bridge(port)
            found = bridge.take({"/bodies", "/nodes/beam", "/step/beam", "/obstacles", "/frames"}, 2)
            bridge.close()
        finally:
            stop.set()
            end.set()
            publisher.join()
            thread.join()
        write_layout(client, tmp_path / "layout.json")
    entities = [e for update in found["/bodies"] for e in update.entities]
    assert {e.id for e in entities} <= {"beam", "liver"}
    shown = {tuple(map(tuple, np.round(positions(step), 5).tolist())) for step in range(52)}
    for entity in entities:
        points, triangles = corners(entity)
        assert tuple(map(tuple, np.round(points, 5).tolist())) in shown
        np.testing.assert_array_equal(triangles, TRIANGLES)
    for message in found["/step/beam"]:
        assert message.kinetic_energy == object_step("beam", message.step).kinetic_energy
    assert {e.id for update in found["/obstacles"] for e in update.entities} <= {"tool", "floor"}
    assert found["/frames"][0].parent_frame_id == "world" and found["/nodes/beam"][0].point_stride == 24
    assert "/step/liver.iterations" in (tmp_path / "layout.json").read_text()


@pytest.mark.system
def test_a_port_that_is_taken_is_told() -> None:
    import socket

    with socket.socket() as taken, FakeServer() as server, Client(connect=[server.endpoint]) as client:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ClientError, match=f"cannot listen on 127.0.0.1:{port}: "):
            serve(client, "127.0.0.1", port, lambda _: None)
