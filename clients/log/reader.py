# SPDX-License-Identifier: MIT
"""A recorded run: scene, meshes, frames, per-step scalars, interactions, obstacles.

A log that was cut off or damaged is read as far as it goes; `notes` says what is missing. Frames and meshes stay on
disk and are decoded when asked for, so a log may be larger than memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import DecodeError

from clients.errors import BadInput
from clients.log.bad_log import bad_log_is_bad_input
from clients.log.frames import Frame, Mesh, frame_of
from clients.log.meshes import Meshes
from clients.log.obstacles import Obstacle, ObstacleFrame, obstacle_frame_of, obstacle_of
from clients.log.scalars import Columns, Rows, columns
from protocol import messages_pb2 as pb
from protocol.log_file import LogFile, LogMessage
from protocol.refused import Refused


@dataclass
class ObjectLog:
    """The records of one object."""

    name: str
    meshes: Meshes  # by epoch
    frames: list[tuple[int, int, int, int]] = field(default_factory=list)  # (step, epoch, offset, number)
    rows: Rows = field(default_factory=Rows)
    interactions: list[tuple[float, pb.Interaction]] = field(default_factory=list)  # (time [s], push or grab)

    @property
    def epochs(self) -> list[int]:
        """Topology epoch of each frame."""
        return [epoch for _, epoch, _, _ in self.frames]


class Log:
    """Opens and scans a log. Raises BadInput if it is none, or one of another protocol version.

    >>> with Log("run.mcap") as log:
    ...     for frame in log.frames("beam"):
    ...         print(frame.step, frame.x.shape)
    """

    def __init__(self, path: str | Path, progress: Callable[[int], None] = lambda _: None) -> None:
        self.path = Path(path)
        self.scene: pb.Scene | None = None
        self.objects: dict[str, ObjectLog] = {}
        self.obstacles: dict[str, Obstacle] = {}
        self.poses: dict[str, list[ObstacleFrame]] = {}  # of obstacles that move, at recorded frames
        self.parameters: list[pb.ParameterSet] = []  # set while the run was made
        self._malformed: list[str] = []
        with bad_log_is_bad_input():
            self._file = LogFile.open(self.path)
            try:
                for message in self._file.messages(progress):
                    self._keep(message)
            except BaseException:
                self.close()
                raise
        for found in self.objects.values():
            found.frames.sort()
        for poses in self.poses.values():
            poses.sort(key=lambda pose: pose.step)

    @property
    def complete(self) -> bool:
        """True if the file was closed by its writer and every block of it could be read."""
        return self._file.whole and not self._malformed

    @property
    def notes(self) -> list[str]:
        """One sentence for each gap; empty for a complete log."""
        notes = self._file.notes()
        if self._malformed:
            notes.append(
                f"{self.path}: {len(self._malformed)} malformed messages left out, first: {self._malformed[0]}"
            )
        notes += [f"{self.path}: object {name!r}: {note}" for name, found in self.objects.items()
                  for note in found.rows.notes()]  # fmt: skip
        return notes

    def object_log(self, name: str) -> ObjectLog:
        """Returns the records of an object. Raises BadInput that names the objects of the log."""
        if name not in self.objects:
            known = ", ".join(sorted(self.objects)) or "none"
            raise BadInput(f"{self.path}: no object {name!r}; objects in the log: {known}")
        return self.objects[name]

    def mesh(self, name: str, epoch: int) -> Mesh:
        """Returns the mesh of an object in an epoch. Raises BadInput if it is not in the log."""
        return self._meshes(name, epoch)[epoch]

    def uncut(self, name: str, epoch: int) -> int:
        """Returns the epoch of the mesh of which that of an epoch is a part, or is. Raises BadInput as `mesh`."""
        return self._meshes(name, epoch).uncut(epoch)

    def scalars(self, name: str) -> Columns:
        """Returns the scalars per step, ascending in step: arrays (k,) by the names in scalars.py."""
        return columns(self.object_log(name).rows)

    def frame(self, name: str, index: int) -> Frame:
        """Returns frame `index` in the order of steps, negative from the end. Raises BadInput if there is none."""
        frames = self.object_log(name).frames
        if not -len(frames) <= index < len(frames):
            raise BadInput(f"{self.path}: no frame {index} of object {name!r}; {len(frames)} frames were recorded")
        frame = frame_of(pb.State.FromString(self._data(*frames[index][2:])))
        nodes = self.object_log(name).meshes.nodes(frame.epoch)
        if nodes not in (None, len(frame.x)):
            raise BadInput(f"{self.path}: step {frame.step} of {name!r} has {len(frame.x)} nodes, its mesh has {nodes}")
        return frame

    def frames(self, name: str) -> Iterator[Frame]:
        """Yields the frames of an object in the order of steps, decoded one by one."""
        return (self.frame(name, index) for index in range(len(self.object_log(name).frames)))

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _data(self, offset: int, number: int) -> bytes:
        """Returns the data of a message. Raises BadInput if the file was changed since it was opened."""
        with bad_log_is_bad_input():
            return self._file.data(offset, number)

    def _meshes(self, name: str, epoch: int) -> Meshes:
        meshes = self.object_log(name).meshes
        if epoch not in meshes:
            raise BadInput(f"{self.path}: the mesh of object {name!r}, epoch {epoch}, is not in the log")
        return meshes

    def _keep(self, message: LogMessage) -> None:
        try:
            self._decode(message)
        except (Refused, DecodeError) as error:
            self._malformed.append(f"{message.topic}: {error}")

    def _decode(self, message: LogMessage) -> None:
        if message.topic == "/scene":
            self.scene = pb.Scene.FromString(message.data)
            return
        if message.topic == "/parameters":
            self.parameters.append(pb.ParameterSet.FromString(message.data))
            return
        if message.topic in ("/touch", "/targets", "/resets", "/checkpoint"):
            return  # for replays that simulate
        if message.kind in ("obstacle", "pose") and message.object:
            self._decode_obstacle(message)
            return
        if message.kind not in ("topology", "state", "step", "interaction", "factor") or not message.object:
            raise Refused("a message of an unknown channel")
        if message.object not in self.objects:
            self.objects[message.object] = ObjectLog(message.object, Meshes(self._data))
        found = self.objects[message.object]
        if message.kind == "topology":
            found.meshes.add(pb.Topology.FromString(message.data), message.offset, message.number)
        elif message.kind == "state":
            frame = frame_of(pb.State.FromString(message.data))
            found.frames.append((frame.step, frame.epoch, message.offset, message.number))
        elif message.kind == "step":
            found.rows.take(pb.ObjectStep.FromString(message.data))
        elif message.kind == "interaction":
            found.interactions.append((message.time / 1e9, pb.Interaction.FromString(message.data)))

    def _decode_obstacle(self, message: LogMessage) -> None:
        if message.kind == "obstacle":
            self.obstacles[message.object] = obstacle_of(pb.Obstacle.FromString(message.data))
        else:
            pose = obstacle_frame_of(pb.ObstaclePose.FromString(message.data))
            self.poses.setdefault(message.object, []).append(pose)
