# SPDX-License-Identifier: MIT
"""A run as channels of Foxglove and Lichtblick, for a file and for a live server.

/bodies and /obstacles (SceneUpdate) hold surfaces, /nodes/OBJECT (PointCloud) nodes with displacement, speed and
stress, /step/OBJECT the ObjectStep of each step, /reaction/OBJECT/WHAT and /reading/OBJECT/OF/QUANTITY what it lists,
each in a channel of its own, so that a plot finds it under one path. The schemas are the published ones, and ours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import foxglove
import numpy as np
from foxglove import messages as fm
from foxglove.channels import FrameTransformChannel, PointCloudChannel, SceneUpdateChannel
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import Message
from numpy.typing import NDArray

from clients.log.frames import Frame, Mesh
from clients.log.obstacles import Obstacle, Pose
from clients.log.scalars import reaction_name
from clients.log.von_mises import StressField
from clients.viewer.colors import colors
from clients.viewer.obstacle_surface import COLOR, obstacle_surface
from clients.viewer.surface import Surface
from protocol import messages_pb2 as pb

WORLD, SCENE = "world", "scene"  # frames: z up, as these programs have it, and that of the scene, y up
PALETTE = [fm.Color(r=r / 255, g=g / 255, b=b / 255, a=1.0) for r, g, b, _ in colors(np.arange(256.0), 255.0).tolist()]
STONE = fm.Color(r=COLOR[0] / 255, g=COLOR[1] / 255, b=COLOR[2] / 255, a=1.0)
UPRIGHT = fm.Quaternion(w=0.5**0.5, x=0.5**0.5, y=0.0, z=0.0)  # turns y up


class FoxgloveScene:
    """Logs frames and steps to the sinks of a context.

    clock: gives the time of a message [ns since 1970] for a simulated time [s]. top: displacement of the last
    colour [m], which grows with what is shown.
    """

    def __init__(self, context: foxglove.Context, clock: Callable[[float], int], top: float = 0.0) -> None:
        self._context, self._clock, self._top = context, clock, top
        self._bodies = SceneUpdateChannel("/bodies", context=context)
        self._solids = SceneUpdateChannel("/obstacles", context=context)
        self._frames = FrameTransformChannel("/frames", context=context)
        self._clouds: dict[str, PointCloudChannel] = {}
        self._messages: dict[str, foxglove.Channel] = {}
        self._surfaces: dict[str, tuple[Mesh, Surface, StressField | None]] = {}
        self._shapes: dict[str, tuple[list[Any], list[int]]] = {}  # points and indices of each obstacle

    def announce(self, names: Iterable[str]) -> None:
        """Makes the channels of objects, so that they are known before the first message."""
        for name in names:
            self._cloud_of(name)
            self._channel_of(f"/step/{name}", pb.ObjectStep())

    def upright(self, time: float) -> None:
        """Logs how the scene lies in the world."""
        at = self._clock(time)
        turned = fm.FrameTransform(
            timestamp=_stamp(at), parent_frame_id=WORLD, child_frame_id=SCENE, rotation=UPRIGHT,
            translation=fm.Vector3(x=0.0, y=0.0, z=0.0),
        )  # fmt: skip
        self._frames.log(turned, log_time=at)

    def frame(self, frame: Frame, mesh: Mesh) -> bool:
        """Logs surface and nodes of an object. Returns False for positions that are not finite, which are not shown."""
        if not np.isfinite(frame.x).all():
            return False
        surface, stress = self._surface(mesh)
        values = surface.values(frame.x)
        self._top = max(self._top, float(values.max(initial=0.0)))
        place = np.rint(np.clip(values / self._top if self._top > 0 else 0 * values, 0, 1) * 255).astype(int)
        triangles = fm.TriangleListPrimitive(
            points=_points(surface.points(frame.x)),
            colors=[PALETTE[k] for k in place.tolist()],
            indices=surface.triangles.ravel().tolist(),
        )
        at = self._clock(frame.time)
        self._bodies.log(fm.SceneUpdate(entities=[_entity(frame.object, triangles, at)]), log_time=at)
        self._cloud(frame, mesh, stress, at)
        return True

    def step(self, message: pb.ObjectStep) -> None:
        """Logs the scalars of a step, and each reaction and reading of it in a channel of its own."""
        name, time = message.header.object, message.time
        self._log(f"/step/{name}", message, time)
        for reaction in message.reactions:
            self._log(reaction_topic(name, reaction_name(reaction)), reaction, time)
        for reading in message.readings:
            self._log(f"/reading/{name}/{reading.of}/{reading.quantity}", reading, time)

    def obstacle(self, obstacle: Obstacle, box: tuple[NDArray, NDArray]) -> None:
        """Makes the shape of an obstacle known; `pose` shows it. box: around the bodies [m], which a plane reaches."""
        vertices, triangles = obstacle_surface(obstacle, *box)
        if len(vertices):
            self._shapes[obstacle.name] = _points(vertices), triangles.ravel().tolist()

    def pose(self, name: str, pose: Pose, time: float) -> None:
        """Logs an obstacle where it is."""
        if name not in self._shapes:
            return
        at, (points, indices) = self._clock(time), self._shapes[name]
        x, y, z = pose.position
        w, i, j, k = pose.rotation
        placed = fm.Pose(position=fm.Vector3(x=x, y=y, z=z), orientation=fm.Quaternion(w=w, x=i, y=j, z=k))
        triangles = fm.TriangleListPrimitive(pose=placed, points=points, color=STONE, indices=indices)
        self._solids.log(fm.SceneUpdate(entities=[_entity(name, triangles, at)]), log_time=at)

    def _surface(self, mesh: Mesh) -> tuple[Surface, StressField | None]:
        known = self._surfaces.get(mesh.object)
        if known is None or known[0].epoch != mesh.epoch:
            elastic = len(mesh.young) > 0
            stress = StressField(mesh.rest, mesh.tets, mesh.young, mesh.poisson) if elastic else None
            known = self._surfaces[mesh.object] = mesh, Surface(mesh, "displacement"), stress
        return known[1], known[2]

    def _cloud(self, frame: Frame, mesh: Mesh, stress: StressField | None, at: int) -> None:
        columns = {"x": frame.x[:, 0], "y": frame.x[:, 1], "z": frame.x[:, 2]}
        columns["displacement"] = np.linalg.norm(frame.x - mesh.rest, axis=1)  # m
        columns["speed"] = np.linalg.norm(frame.v, axis=1)  # m/s
        if stress is not None:
            columns["von_mises"] = stress.nodes(frame.x)  # Pa
        kind = fm.PackedElementFieldNumericType.Float32
        cloud = fm.PointCloud(
            timestamp=_stamp(at), frame_id=SCENE, point_stride=4 * len(columns),
            pose=fm.Pose(position=fm.Vector3(x=0.0, y=0.0, z=0.0), orientation=fm.Quaternion(w=1.0)),
            fields=[fm.PackedElementField(name=name, offset=4 * k, type=kind) for k, name in enumerate(columns)],
            data=np.stack(list(columns.values()), axis=1).astype("<f4").tobytes(),
        )  # fmt: skip
        self._cloud_of(frame.object).log(cloud, log_time=at)

    def _cloud_of(self, name: str) -> PointCloudChannel:
        if name not in self._clouds:
            self._clouds[name] = PointCloudChannel(f"/nodes/{name}", context=self._context)
        return self._clouds[name]

    def _log(self, topic: str, message: Message, time: float) -> None:
        self._channel_of(topic, message).log(message.SerializeToString(), log_time=self._clock(time))

    def _channel_of(self, topic: str, message: Message) -> foxglove.Channel:
        if topic not in self._messages:
            self._messages[topic] = foxglove.Channel(
                topic, schema=_schema(message), message_encoding="protobuf", context=self._context
            )
        return self._messages[topic]


def reaction_topic(name: str, what: str) -> str:
    """Returns the topic of what an object exerts on something, by the name that `reaction_name` has for it."""
    return f"/reaction/{name}/{what.replace(':', '_')}"


def _schema(message: Message) -> foxglove.Schema:
    """Returns the schema of a message of ours, with the whole file that it is of."""
    file = FileDescriptorProto()
    message.DESCRIPTOR.file.CopyToProto(file)
    data = FileDescriptorSet(file=[file]).SerializeToString()
    return foxglove.Schema(name=message.DESCRIPTOR.full_name, encoding="protobuf", data=data)


def _stamp(at: int) -> fm.Timestamp:
    return fm.Timestamp(sec=at // 1_000_000_000, nsec=at % 1_000_000_000)


def _points(x: NDArray) -> list[Any]:
    return [fm.Point3(x=a, y=b, z=c) for a, b, c in x.tolist()]


def _entity(name: str, triangles: fm.TriangleListPrimitive, at: int) -> fm.SceneEntity:
    """Returns an entity, which replaces that of the same name."""
    return fm.SceneEntity(timestamp=_stamp(at), frame_id=SCENE, id=name, triangles=[triangles])
