# SPDX-License-Identifier: MIT
"""The bridges to ROS 2 and to OpenIGTLink, each between a real server and a small stand-in of the other side."""

import base64
import json
import os
import re
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import ServerConnection, serve

from protocol.channels import SERVER_NAME
from tests.ports import free_endpoint, free_port
from tests.system.server_process import PATIENCE, Stage, until
from tests.system.test_replay_of_a_server import CPU

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]
SCENE = ROOT / "deploy" / "scenes" / "haptics.toml"
TIME, VECTOR = {"sec": int, "nanosec": int}, {"x": float, "y": float, "z": float}
HEADER = {"stamp": TIME, "frame_id": str}
FIELD = {"name": str, "offset": int, "datatype": int, "count": int}
MESSAGES = {  # of ROS 2, common_interfaces: fields and types; rosbridge refuses messages with others
    "sensor_msgs/PointCloud2": {
        "header": HEADER, "height": int, "width": int, "fields": [FIELD], "is_bigendian": bool, "point_step": int,
        "row_step": int, "data": str, "is_dense": bool,
    },
    "geometry_msgs/WrenchStamped": {"header": HEADER, "wrench": {"force": VECTOR, "torque": VECTOR}},
    "geometry_msgs/PoseStamped": {"header": HEADER, "pose": {"position": VECTOR, "orientation": VECTOR | {"w": float}}},
    "geometry_msgs/PointStamped": {"header": HEADER, "point": VECTOR},
    "std_msgs/Empty": {},
}  # fmt: skip
NOW = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "world"}


def fits(value: Any, kind: Any) -> bool:
    """True if a value of JSON is one of a message type."""
    if isinstance(kind, dict):
        return isinstance(value, dict) and value.keys() == kind.keys() and all(fits(value[k], kind[k]) for k in kind)
    if isinstance(kind, list):
        return isinstance(value, list) and all(fits(each, kind[0]) for each in value)
    return type(value) is kind


class Rosbridge:
    """rosbridge as the bridge sees it: topics have the type that they were announced with, and hold the newest message.

    Operations of rosbridge 2.0 (ROSBRIDGE_PROTOCOL.md): advertise, publish, subscribe.
    """

    def __init__(self) -> None:
        self.types: dict[str, str] = {}
        self.wanted: dict[str, str] = {}
        self.newest: dict[str, dict[str, Any]] = {}
        self.faults: list[str] = []
        self.connection: ServerConnection | None = None
        self.server = serve(self.talk, "127.0.0.1", 0)
        self.url = f"ws://127.0.0.1:{self.server.socket.getsockname()[1]}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def talk(self, connection: ServerConnection) -> None:
        self.connection = connection
        for text in connection:
            message = json.loads(text)
            topic = message["topic"]
            if message["op"] == "advertise":
                self.types[topic] = message["type"]
            elif message["op"] == "subscribe":
                self.wanted[topic] = message["type"]
            elif message["op"] != "publish" or topic not in self.types:
                self.faults.append(f"{message['op']} {topic}")
            elif not fits(message["msg"], MESSAGES[self.types[topic]]):
                self.faults.append(f"{topic}: {message['msg']}")
            else:
                self.newest[topic] = message["msg"]

    def say(self, topic: str, **message: Any) -> None:
        """A message of another node, on a topic that the bridge has subscribed."""
        assert self.connection is not None and (not message or fits(message, MESSAGES[self.wanted[topic]]))
        self.connection.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    yield made
    made.close()


@pytest.fixture
def started(stage: Stage, tmp_path: Path) -> Iterator[Any]:
    """Starts an example beside a server of the scene with a tool."""
    stage.server(SCENE, "--set", "effects.gravity.g=[0, 0, 0]", *CPU)
    with stage.client():  # the server is there
        pass
    begun: list[subprocess.Popen[str]] = []

    def start(name: str, *arguments: str) -> "subprocess.Popen[str]":
        command = [sys.executable, str(ROOT / "clients" / "examples" / name), *arguments]
        where = {**os.environ, "WARPFACTOR_CONNECT": stage.endpoint, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(command, env=where, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        begun.append(process)
        assert process.stdout is not None and process.stderr is not None
        assert "organ" in (line := process.stdout.readline()), line + process.stderr.read()
        return process

    yield start
    for process in begun:
        process.kill()
        process.communicate(timeout=PATIENCE)


def test_ros_2_sees_a_body_grabs_it_and_moves_a_tool(stage: Stage, started: Any) -> None:
    ros = Rosbridge()
    bridge = started("ros2.py", "--rosbridge", ros.url)
    cloud, wrench = "/warpfactor/organ/points", "/warpfactor/tool/wrench"
    until(lambda: {cloud, wrench} <= ros.newest.keys(), "points and forces come")
    with stage.client() as client:
        rest = client.meshes()["organ"].rest

        def points() -> np.ndarray:
            found = ros.newest[cloud]
            assert found["point_step"] == 12 and found["row_step"] == 12 * found["width"] and found["height"] == 1
            assert [(f["name"], f["offset"], f["datatype"]) for f in found["fields"]] == [
                ("x", 0, 7),
                ("y", 4, 7),
                ("z", 8, 7),
            ]
            return np.frombuffer(base64.b64decode(found["data"]), "<f4").reshape(found["width"], 3)

        np.testing.assert_allclose(points(), rest, atol=1e-5)
        corner = dict(zip("xyz", (0.15, 0.05, 0.1), strict=True))
        ros.say("/warpfactor/organ/grab", header=NOW, point=corner)
        until(lambda: ros.newest.get("/warpfactor/organ/grab_wrench"), "the corner is held")
        ros.say("/warpfactor/organ/grab", header=NOW, point=corner | {"y": 0.08})
        moved = int(np.linalg.norm(rest - list(corner.values()), axis=1).argmin())
        until(lambda: points()[moved, 1] > 0.055, "the corner follows")
        until(lambda: ros.newest["/warpfactor/organ/grab_wrench"]["wrench"]["force"]["y"] < 0, "the hand is drawn down")
        ros.say("/warpfactor/organ/release")
        until(lambda: abs(points()[moved, 1] - 0.05) < 1e-3, "it is let go and goes back")
        down = {
            "position": {"x": 0.075, "y": 0.105, "z": 0.05},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        }
        ros.say("/warpfactor/tool/target", header=NOW, pose=down)
        until(lambda: ros.newest[wrench]["wrench"]["force"]["y"] > 0, "the tool presses the organ")
        ros.say("/warpfactor/tool/target", header=NOW, pose=down | {"orientation": dict.fromkeys("xyzw", 0.0)})
        assert bridge.stderr is not None and "tool/target: the orientation is no quaternion" in bridge.stderr.readline()
    assert ros.faults == []
    assert ros.connection is not None
    ros.connection.close()
    assert bridge.wait(PATIENCE) == 1 and bridge.stderr.read().startswith("ros2: ")


def test_ros_2_grabs_again_after_a_reset_and_ends_with_the_server(stage: Stage, started: Any) -> None:
    ros = Rosbridge()
    bridge = started("ros2.py", "--rosbridge", ros.url)
    corner = dict(zip("xyz", (0.15, 0.05, 0.1), strict=True))

    def height() -> float:
        """Of the corner [m]."""
        points = base64.b64decode(ros.newest.get("/warpfactor/organ/points", {"data": ""})["data"])
        return float(np.frombuffer(points, "<f4").reshape(-1, 3)[moved, 1]) if points else 0.0

    def follows() -> bool:
        for y in (0.05, 0.08):  # where it is, if it is not held yet, and where it is drawn to
            ros.say("/warpfactor/organ/grab", header=NOW, point=corner | {"y": y})
        time.sleep(0.1)
        return height() > 0.055

    with stage.client() as client:
        rest = client.meshes()["organ"].rest
        moved = int(np.linalg.norm(rest - list(corner.values()), axis=1).argmin())
        until(lambda: len(ros.wanted) == 3, "the bridge listens")
        client.pause()
        ros.say("/warpfactor/organ/grab", header=NOW, point=corner)  # no step is with it before it goes on
        time.sleep(0.2)
        client.resume()
        until(follows, "the corner follows")
        client.reset("organ")
        until(lambda: 0 < height() < 0.051, "it is back")
        until(follows, "it follows again")
        client.stop()
    assert bridge.wait(PATIENCE) == 1 and ros.faults == []
    assert bridge.stderr is not None and bridge.stderr.read().splitlines()[-1].startswith("ros2: ")


def test_slicer_sees_surfaces_and_moves_a_tool(stage: Stage, started: Any) -> None:
    """A client of pyigtl stands for Slicer. Surfaces, which it does not know, are read here by the specification."""
    pyigtl = pytest.importorskip("pyigtl")
    messages = pytest.importorskip("pyigtl.messages")

    class PolyData(messages.MessageBase):
        def _unpack_content(self, content: bytes) -> None:
            counts = struct.unpack(">10I", content[:40])
            assert [counts[k] for k in (1, 2, 3, 4, 7, 8, 9)] == [0] * 7  # only points and polygons
            self.points = np.frombuffer(content, ">f4", 3 * counts[0], 40).reshape(-1, 3)
            cells = np.frombuffer(content, ">u4", offset=40 + 12 * counts[0]).reshape(-1, 4)
            assert 16 * counts[5] == counts[6] == cells.nbytes and (cells[:, 0] == 3).all()
            self.triangles, self._valid_message = cells[:, 1:], True

    port = free_port()
    bridge = started("openigtlink.py", "--port", str(port))
    messages.message_type_to_class_constructor["POLYDATA"] = PolyData
    try:
        slicer = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
        surface = slicer.wait_for_message("organ", timeout=PATIENCE)
        with stage.client() as client:
            mesh = client.meshes()["organ"]
            np.testing.assert_allclose(surface.points, 1000 * mesh.rest, atol=1e-2)
            np.testing.assert_array_equal(surface.triangles, mesh.triangles)
            turned = np.array([[0.0, -1, 0, 75], [1, 0, 0, 150], [0, 0, 1, 50], [0, 0, 0, 1]])  # a quarter about z
            slicer.send_message(pyigtl.TransformMessage(turned, device_name="tool"))
            poses = client.poses(["tool"])
            seen: list[Any] = []

            def arrived() -> bool:
                seen.extend(poses.newest())
                return bool(seen) and np.allclose(seen[-1].pose.position, (0.075, 0.15, 0.05), atol=1e-4)

            until(arrived, "the tool is there")
            until(lambda: bool(seen.extend(poses.newest())) or abs(seen[-1].pose.rotation[3]) > 0.7, "and turned")
            np.testing.assert_allclose(np.abs(seen[-1].pose.rotation), [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-2)
            until(lambda: np.allclose(shown(slicer), turned, atol=1), "its pose comes back")
            slicer.send_message(pyigtl.TransformMessage(2 * turned, device_name="tool"))
            assert bridge.stderr is not None and re.search("tool: the matrix is no rotation", bridge.stderr.readline())
        slicer.stop()
    finally:
        del messages.message_type_to_class_constructor["POLYDATA"]


def shown(slicer: Any) -> np.ndarray:
    """The newest pose of the tool that has come [mm]."""
    found: np.ndarray = slicer.wait_for_message("tool.pose", timeout=PATIENCE).matrix
    return found


def test_an_example_without_a_server_says_so(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "clients" / "examples" / "ros2.py"), "--server", SERVER_NAME]
    where = {**os.environ, "WARPFACTOR_CONNECT": free_endpoint(), "PYTHONPATH": str(ROOT)}
    begun = time.monotonic()
    done = subprocess.run(command, env=where, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 1 and done.stderr.startswith("ros2: no server ")
    assert time.monotonic() - begun < PATIENCE
