# SPDX-License-Identifier: MIT
"""A bridge to 3D Slicer and others by OpenIGTLink: surfaces as POLYDATA, poses of tools as TRANSFORM, both ways.

    python clients/examples/openigtlink.py --port 18944

In Slicer: module OpenIGTLinkIF, a connector of type Client to this port, Active. It needs the package pyigtl. Lengths
there are mm. A TRANSFORM that comes under the name of an obstacle with `moved = "client"` sends it to that pose.
"""

import argparse
import struct
import sys
import time
from typing import Any

import numpy as np
import pyigtl
from numpy.typing import NDArray
from pyigtl.messages import MessageBase

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.log.obstacles import Pose
from protocol.channels import SERVER_NAME

MM = 1000.0  # in a metre


class PolyData(MessageBase):  # type: ignore[misc]  # pyigtl has no types
    """POLYDATA of OpenIGTLink 2: points (n, 3) [mm] and triangles (t, 3), big-endian, without attributes."""

    def __init__(self, points: NDArray[Any], triangles: NDArray[Any], device_name: str):
        super().__init__(device_name=device_name)
        self._message_type, self._valid_message = "POLYDATA", True
        self.points, self.triangles = points, triangles

    def _pack_content(self) -> bytes:
        corners = np.insert(self.triangles, 0, 3, axis=1).astype(">u4").tobytes()  # each with the number of its corners
        # Counts, and bytes where they are of several: points, vertices, lines, polygons, strips, attributes.
        counts = struct.pack(">10I", len(self.points), 0, 0, 0, 0, len(self.triangles), len(corners), 0, 0, 0)
        return counts + self.points.astype(">f4").tobytes() + corners


def matrix(where: Pose) -> NDArray[np.float64]:
    """Pose as a 4 x 4 matrix [mm]."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = where.matrix(), MM * np.array(where.position)
    return made


def pose(given: NDArray[Any]) -> tuple[list[float], list[float]]:
    """Position [m] and unit quaternion w, x, y, z of a 4 x 4 matrix [mm]. Raises ValueError if it is no pose."""
    turn = np.asarray(given, float)[:3, :3]
    if not np.isfinite(given).all() or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
        raise ValueError("the matrix is no rotation and translation")
    # The eigenvector of the largest eigenvalue: Bar-Itzhack 2000, which has no special cases.
    (a, b, c), (d, e, f), (g, h, i) = turn
    symmetric = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    quaternion = np.linalg.eigh(np.array(symmetric))[1][:, -1]
    return list(np.asarray(given, float)[:3, 3] / MM), list(quaternion if quaternion[0] >= 0 else -quaternion)


class Bridge:
    """One sim-server on one side, a server of OpenIGTLink on the other."""

    def __init__(self, client: Client, link: Any):
        self.client, self.link = client, link
        self.meshes = client.meshes()
        obstacles = client.obstacles().values()
        self.tools = {o.name: client.obstacle(o.name) for o in obstacles if o.moved == "client"}
        self.states, self.poses = client.states(), client.poses() if obstacles else None

    def send(self) -> None:
        """Sends what is new; surfaces that were cut are asked for again."""
        for frame in self.states.newest():
            mesh = self.meshes.get(frame.object)
            if mesh is None or mesh.epoch != frame.epoch or len(mesh.rest) != len(frame.x):
                self.meshes = self.client.meshes()
                continue
            self.link.send_message(PolyData(MM * frame.x, mesh.triangles, frame.object), wait=False)
        for moved in self.poses.newest() if self.poses else ():
            shown = pyigtl.TransformMessage(matrix(moved.pose), device_name=f"{moved.obstacle}.pose")
            self.link.send_message(shown, wait=False)

    def receive(self) -> None:
        """Obeys the newest TRANSFORM of each tool; what cannot be obeyed is told."""
        for message in self.link.get_latest_messages():
            tool = self.tools.get(message.device_name)
            if tool is None or message.message_type != "TRANSFORM":
                continue
            try:
                tool.move(*pose(message.matrix))
            except (BadInput, ValueError) as error:
                print(f"openigtlink: {message.device_name}: {error}", file=sys.stderr, flush=True)


def main() -> None:
    """Runs until Ctrl-C, or the sim-server is gone."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--port", type=int, default=18944, help="of this machine alone")
    parser.add_argument("--rate", type=float, default=20.0, metavar="HZ", help="of what is sent")
    parser.add_argument("--server", default=SERVER_NAME, metavar="NAME")
    o = parser.parse_args()
    if not 0 < o.rate <= 1000:
        parser.error("--rate: must be above 0 and at most 1000")
    try:
        with Client(o.server) as client:
            bridge = Bridge(client, pyigtl.OpenIGTLinkServer(port=o.port, local_server=True))
            print(f"openigtlink: {', '.join(bridge.meshes)} at 127.0.0.1:{o.port}", flush=True)
            alive = time.monotonic()
            while True:
                time.sleep(1 / o.rate)
                bridge.send()
                bridge.receive()
                if time.monotonic() > alive + 1:
                    client.status()  # raises when the server is gone
                    alive = time.monotonic()
    except (BadInput, ClientError, OSError) as error:
        sys.exit(f"openigtlink: {error}")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
