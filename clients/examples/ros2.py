# SPDX-License-Identifier: MIT
"""A bridge to ROS 2 through rosbridge: bodies as point clouds, forces as wrenches; poses move tools, points bodies.

    ros2 launch rosbridge_server rosbridge_websocket_launch.xml
    python clients/examples/ros2.py --rosbridge ws://127.0.0.1:9090

It needs no ROS where it runs, only the package websockets, and works with every distribution that has rosbridge.

published   /warpfactor/OBJECT/points        sensor_msgs/PointCloud2       all nodes [m]
            /warpfactor/OBJECT/grab_wrench   geometry_msgs/WrenchStamped   what the hand of a grab feels [N]
            /warpfactor/OBSTACLE/wrench      geometry_msgs/WrenchStamped   what objects exert on it [N, N m]
subscribed  /warpfactor/OBSTACLE/target      geometry_msgs/PoseStamped     where it goes
            /warpfactor/OBJECT/grab          geometry_msgs/PointStamped    grabs the nearest node, then moves it
            /warpfactor/OBJECT/release       std_msgs/Empty
"""

import argparse
import base64
import json
import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.grab import Grab
from clients.log.frames import Frame
from protocol.channels import SERVER_NAME

FLOAT32 = 7  # of sensor_msgs/PointField


def header(frame_id: str) -> dict[str, Any]:
    """std_msgs/Header of now."""
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def point_cloud(frame: Frame, frame_id: str) -> dict[str, Any]:
    """sensor_msgs/PointCloud2 of all nodes."""
    x = np.ascontiguousarray(frame.x, "<f4")
    fields = [{"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1} for k, name in enumerate("xyz")]
    return {
        "header": header(frame_id), "height": 1, "width": len(x), "fields": fields, "is_bigendian": False,
        "point_step": 12, "row_step": 12 * len(x), "data": base64.b64encode(x.tobytes()).decode(), "is_dense": True,
    }  # fmt: skip


def wrench(force: Any, torque: Any, frame_id: str) -> dict[str, Any]:
    """geometry_msgs/WrenchStamped."""
    parts = {name: dict(zip("xyz", map(float, v), strict=True)) for name, v in (("force", force), ("torque", torque))}
    return {"header": header(frame_id), "wrench": parts}


def triple(given: dict[str, Any], *names: str) -> list[float]:
    """Numbers of a message. Raises KeyError, TypeError and ValueError."""
    values = [float(given[name]) for name in names]
    if not all(map(math.isfinite, values)):
        raise ValueError("a number is not finite")
    return values


class Bridge:
    """One server on one side, rosbridge on the other."""

    def __init__(self, client: Client, ros: Connection, frame_id: str, stiffness: float, max_force: float):
        self.client, self.ros, self.frame_id = client, ros, frame_id
        self.stiffness, self.max_force = stiffness, max_force  # of grabs
        self.objects = list(client.scene().objects)
        self.tools = {o.name: client.obstacle(o.name) for o in client.obstacles().values() if o.moved == "client"}
        self.grabs: dict[str, Grab] = {}
        self.states = client.states()
        self.taken: dict[str, Callable[[dict[str, Any]], None]] = {}
        for name in self.objects:
            self.offer(f"{name}/points", "sensor_msgs/PointCloud2")
            self.offer(f"{name}/grab_wrench", "geometry_msgs/WrenchStamped")
            self.take(f"{name}/grab", "geometry_msgs/PointStamped", lambda m, name=name: self.grab(name, m))
            self.take(f"{name}/release", "std_msgs/Empty", lambda m, name=name: self.release(name))
        for name in self.tools:
            self.offer(f"{name}/wrench", "geometry_msgs/WrenchStamped")
            self.take(f"{name}/target", "geometry_msgs/PoseStamped", lambda m, name=name: self.move(name, m))

    def send(self, op: str, topic: str, **more: Any) -> None:
        """Sends an operation of rosbridge."""
        self.ros.send(json.dumps({"op": op, "topic": f"/warpfactor/{topic}", **more}))

    def offer(self, topic: str, kind: str) -> None:
        """Says what will be published."""
        self.send("advertise", topic, type=kind)

    def take(self, topic: str, kind: str, what: Any) -> None:
        """Has rosbridge send a topic, the newest message alone where there are more."""
        self.taken[f"/warpfactor/{topic}"] = what
        self.send("subscribe", topic, type=kind, queue_length=1)

    def publish(self) -> None:
        """Publishes what is new."""
        for frame in self.states.newest():
            self.send("publish", f"{frame.object}/points", msg=point_cloud(frame, self.frame_id))
        forces = self.client.forces
        for name in self.tools:
            with suppress(ClientError):  # no step has come so far
                load = forces.obstacle(name, timeout=0)
                self.send("publish", f"{name}/wrench", msg=wrench(load.force, load.torque, self.frame_id))
        for name, grab in self.grabs.items():
            with suppress(ClientError):  # the newest step is not with the grab: it begins, or is over
                hand = forces.grab(grab.interaction.id, timeout=0).force
                self.send("publish", f"{name}/grab_wrench", msg=wrench(hand, (0, 0, 0), self.frame_id))

    def receive(self, until: float) -> None:
        """Obeys what comes until a time (time.monotonic) [s]; what cannot be obeyed is told."""
        while (left := until - time.monotonic()) > 0:
            try:
                message = json.loads(self.ros.recv(timeout=left))
            except TimeoutError:
                return
            except ValueError as error:
                message = {"op": "status", "level": "error", "msg": f"no JSON: {error}"}
            if not isinstance(message, dict):
                continue
            if message.get("op") == "status":
                print(f"rosbridge: {message.get('level')}: {message.get('msg')}", file=sys.stderr, flush=True)
            elif message.get("op") == "publish" and message.get("topic") in self.taken:
                try:
                    self.taken[message["topic"]](message["msg"])
                except (BadInput, KeyError, TypeError, ValueError) as error:
                    print(f"{message['topic']}: {error}", file=sys.stderr, flush=True)

    def move(self, tool: str, message: dict[str, Any]) -> None:
        """Sends a tool to a pose."""
        pose = message["pose"]
        position, rotation = triple(pose["position"], *"xyz"), triple(pose["orientation"], *"wxyz")
        length = math.hypot(*rotation)
        if length < 1e-3:
            raise ValueError("the orientation is no quaternion")
        self.tools[tool].move(position, [each / length for each in rotation])

    def grab(self, name: str, message: dict[str, Any]) -> None:
        """Grabs the node next to a point, or moves the grab that there is."""
        x, y, z = triple(message["point"], *"xyz")
        if name in self.grabs:
            try:
                self.grabs[name].move((x, y, z), wait=False)
            except BadInput:  # it is over, as after a reset: the next point begins another one
                del self.grabs[name]
                raise
        else:
            self.grabs[name] = self.client.grab(name, (x, y, z), None, 0, self.stiffness, self.max_force)

    def release(self, name: str) -> None:
        """Lets go."""
        if (held := self.grabs.pop(name, None)) is not None:
            held.release()


def main() -> None:
    """Runs until Ctrl-C, or one side is gone."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rosbridge", default="ws://127.0.0.1:9090", metavar="URL")
    parser.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="of what is published")
    parser.add_argument("--frame", default="world", metavar="NAME", help="frame_id of messages")
    parser.add_argument("--stiffness", type=float, default=200.0, metavar="N/M", help="of grabs")
    parser.add_argument("--max-force", type=float, default=5.0, metavar="N", help="of grabs")
    parser.add_argument("--server", default=SERVER_NAME, metavar="NAME")
    o = parser.parse_args()
    if not 0 < o.rate <= 1000:
        parser.error("--rate: must be above 0 and at most 1000")
    try:
        with Client(o.server) as client, connect(o.rosbridge, max_size=1 << 20) as ros:
            bridge = Bridge(client, ros, o.frame, o.stiffness, o.max_force)
            print(f"ros2: {', '.join(bridge.objects)} at {o.rosbridge}", flush=True)
            alive = time.monotonic()
            while True:
                until = time.monotonic() + 1 / o.rate
                bridge.publish()
                bridge.receive(until)
                if until > alive + 1:
                    client.status()  # raises when the server is gone
                    alive = until
    except (BadInput, ClientError, OSError, WebSocketException) as error:
        sys.exit(f"ros2: {error}")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
