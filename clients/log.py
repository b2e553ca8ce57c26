# SPDX-License-Identifier: MIT
"""A recorded run: scene, meshes, frames, per-step scalars, interactions.

A log that was cut off or damaged is read as far as it goes; `notes` says what is missing. Frames stay on disk and are
decoded when asked for, so a log may be larger than memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import DecodeError
from mcap.records import Channel, McapRecord
from mcap.records import Message as McapMessage

from clients.errors import BadInput
from clients.frames import Frame, Mesh, frame_of, mesh_of
from clients.scalars import Columns, columns, row
from protocol import Refused
from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog, ChunkFile


@dataclass
class ObjectLog:
    """What the log holds of one object."""

    name: str
    meshes: dict[int, Mesh] = field(default_factory=dict)  # by epoch
    frames: list[tuple[int, int, int, int]] = field(default_factory=list)  # (step, epoch, chunk offset, number in it)
    rows: list[tuple] = field(default_factory=list)
    interactions: list[tuple[float, pb.Interaction]] = field(default_factory=list)  # (time [s], what)

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
        self._malformed: list[str] = []
        self._file = _opened(self.path)
        self._topics: dict[int, str] = {}
        self._cached: tuple[int, list[McapRecord]] = (-1, [])
        try:
            for offset, records in self._file.scan(progress):
                self._check_origin()  # before anything of a foreign file is decoded
                for number, record in enumerate(records):
                    self._keep(offset, number, record)
            self._check_origin()
        except BaseException:
            self._file.close()
            raise
        for found in self.objects.values():
            found.frames.sort()

    @property
    def complete(self) -> bool:
        """True if the file was closed by its writer and every block of it could be read."""
        return self._file.complete and not self._file.problems and not self._malformed

    @property
    def notes(self) -> list[str]:
        """What a reader should know about gaps, one sentence each; empty for a complete log."""
        notes = self._file.notes()
        if self._malformed:
            notes.append(
                f"{self.path}: {len(self._malformed)} malformed messages left out, first: {self._malformed[0]}"
            )
        return notes

    def object_log(self, name: str) -> ObjectLog:
        """Raises BadInput naming the objects that are there."""
        if name not in self.objects:
            known = ", ".join(sorted(self.objects)) or "none"
            raise BadInput(f"{self.path}: no object {name!r}; objects in the log: {known}")
        return self.objects[name]

    def mesh(self, name: str, epoch: int) -> Mesh:
        meshes = self.object_log(name).meshes
        if epoch not in meshes:
            raise BadInput(f"{self.path}: the mesh of object {name!r}, epoch {epoch}, is not in the log")
        return meshes[epoch]

    def scalars(self, name: str) -> Columns:
        """Per-step scalars, ascending in step: arrays (k,) by the names in clients/scalars.py."""
        return columns(self.object_log(name).rows)

    def frame(self, name: str, index: int) -> Frame:
        """Frame `index` in the order of steps, negative from the end. Raises BadInput if there is none."""
        frames = self.object_log(name).frames
        if not -len(frames) <= index < len(frames):
            raise BadInput(f"{self.path}: no frame {index} of object {name!r}; {len(frames)} frames were recorded")
        _, _, offset, number = frames[index]
        if self._cached[0] != offset:
            self._cached = (offset, self._file.chunk(offset))
        record = self._cached[1][number]
        assert isinstance(record, McapMessage)
        frame = frame_of(pb.State.FromString(record.data))
        mesh = self.object_log(name).meshes.get(frame.epoch)
        if mesh is not None and len(mesh.rest) != len(frame.x):
            raise BadInput(
                f"{self.path}: step {frame.step} of {name!r} has {len(frame.x)} nodes, its mesh has {len(mesh.rest)}"
            )
        return frame

    def frames(self, name: str) -> Iterator[Frame]:
        """All frames of an object in the order of steps, decoded one by one."""
        return (self.frame(name, index) for index in range(len(self.object_log(name).frames)))

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_origin(self) -> None:
        try:
            self._file.check_origin()
        except BadLog as error:
            raise BadInput(str(error)) from None

    def _keep(self, offset: int, number: int, record: McapRecord) -> None:
        if isinstance(record, Channel):
            self._topics[record.id] = record.topic
        elif isinstance(record, McapMessage):
            topic = self._topics.get(record.channel_id, "")
            try:
                self._decode(topic, offset, number, record)
            except (Refused, DecodeError) as error:
                self._malformed.append(f"{topic}: {error}")

    def _decode(self, topic: str, offset: int, number: int, record: McapMessage) -> None:
        if topic == "/scene":
            self.scene = pb.Scene.FromString(record.data)
            return
        if topic == "/touch":
            return  # for replays that simulate
        _, _, rest = topic.partition("/")
        kind, _, name = rest.partition("/")
        if kind not in ("topology", "state", "step", "interaction", "factor") or not name:
            raise Refused("a message of an unknown channel")
        found = self.objects.setdefault(name, ObjectLog(name))
        if kind == "topology":
            mesh = mesh_of(pb.Topology.FromString(record.data))
            found.meshes[mesh.epoch] = mesh
        elif kind == "state":
            frame = frame_of(pb.State.FromString(record.data))
            found.frames.append((frame.step, frame.epoch, offset, number))
        elif kind == "step":
            found.rows.append(row(pb.ObjectStep.FromString(record.data)))
        elif kind == "interaction":
            found.interactions.append((record.log_time / 1e9, pb.Interaction.FromString(record.data)))


def _opened(path: Path) -> ChunkFile:
    try:
        return ChunkFile.open(path)
    except BadLog as error:
        raise BadInput(str(error)) from None
