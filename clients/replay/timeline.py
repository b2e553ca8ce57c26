# SPDX-License-Identifier: MIT
"""A log in the order of its simulated time, read from the file as a replay sends it.

The recorder writes in batches, so that the order in the file is not that of time. Only positions are kept in memory.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError, Message

from clients.errors import BadInput
from clients.log.bad_log import bad_log_is_bad_input
from protocol import messages_pb2 as pb
from protocol.log_file import LogFile

KINDS: list[tuple[str, type[Message]]] = [
    ("topology", pb.Topology), ("obstacle", pb.Obstacle), ("step", pb.ObjectStep), ("state", pb.State),
    ("pose", pb.ObstaclePose),
]  # fmt: skip
ONCE = [name in ("topology", "obstacle") for name, _ in KINDS]  # sent before the rest, wherever a replay begins
PLACE = np.dtype([("time", "i8"), ("kind", "i4"), ("number", "i4"), ("offset", "i8"), ("object", "i8")])
_PACK = struct.Struct("<qiiqq")  # of a PLACE


class Timeline:
    """Scene, topologies, steps, states, obstacles and their poses of a log.

    Raises BadInput for a file without a scene, or that is no log.

    notes: one sentence for each gap. end: simulated time of the last record [s].
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda _: None):
        self.path, self.scene = path, pb.Scene()
        self.objects: list[str] = []
        self.malformed = 0
        with bad_log_is_bad_input():
            self._file = LogFile.open(path)
            try:
                self._places = self._scan(progress)
                if not self.scene.objects:
                    raise BadInput(f"{path}: the log holds no scene; its beginning is damaged")
            except BaseException:
                self.close()
                raise

    @property
    def notes(self) -> list[str]:
        return self._file.notes()

    @property
    def end(self) -> float:
        return float(self._places["time"].max(initial=0)) / 1e9

    def between(self, begin: float, end: float) -> Iterator[tuple[float, str, Message]]:
        """Yields (time [s], object or obstacle, message) with begin <= time <= end in order, after the topologies and
        obstacles before it. Raises BadInput if the file was changed since it was opened."""
        places = self._places
        times = places["time"] / 1e9
        wanted = ((times >= begin) | np.array(ONCE)[places["kind"]]) & (times <= end)
        for place in places[wanted]:
            with bad_log_is_bad_input():
                data = self._file.data(int(place["offset"]), int(place["number"]))
            try:
                message = KINDS[place["kind"]][1].FromString(data)
            except DecodeError:
                self.malformed += 1
                continue
            yield max(float(place["time"]) / 1e9, begin), self.objects[place["object"]], message

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Timeline:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _scan(self, progress: Callable[[int], None]) -> np.ndarray:
        """Reads the scene; returns a PLACE of every other message of KINDS, by time, then kind, then file order."""
        kinds = {name: number for number, (name, _) in enumerate(KINDS)}
        numbers: dict[str, int] = {}  # of the objects
        found = bytearray()
        for message in self._file.messages(progress):
            _, kind, name, time, data, offset, number = message
            if kind == "scene":
                self.scene = _scene(self.path, data)
            elif kind in kinds and name:
                found += _PACK.pack(time, kinds[kind], number, offset, numbers.setdefault(name, len(numbers)))
        self.objects = list(numbers)
        table = np.frombuffer(bytes(found), PLACE)
        return table[np.lexsort((np.arange(len(table)), table["kind"], table["time"]))]


def _scene(path: Path, data: bytes) -> pb.Scene:
    try:
        return pb.Scene.FromString(data)
    except DecodeError:
        raise BadInput(f"{path}: the scene in the log cannot be read") from None
