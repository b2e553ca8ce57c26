# SPDX-License-Identifier: MIT
"""A log in the order of its simulated time: what a replay sends, read from the file as it is due.

The recorder writes in batches, so that the order in the file is not quite that of time. Only places are kept in memory.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError, Message
from mcap.records import Channel, McapRecord
from mcap.records import Message as McapMessage

from clients.errors import BadInput
from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog, ChunkFile

KINDS: list[tuple[str, type[Message]]] = [("topology", pb.Topology), ("step", pb.ObjectStep), ("state", pb.State)]
CHUNKS = 8  # kept unpacked, about 1 MiB each
PLACE = np.dtype([("time", "i8"), ("kind", "i4"), ("number", "i4"), ("offset", "i8"), ("object", "i4"), ("pad", "i4")])


class Timeline:
    """Scene, topologies, steps and states of a log. Raises BadInput if it is none, or holds no scene.

    notes: what is missing, one sentence each. end: simulated time of the last record [s].
    """

    def __init__(self, path: Path, progress: Callable[[int], None] = lambda _: None):
        self.path, self.scene = path, pb.Scene()
        self.objects: list[str] = []
        self.malformed = 0
        self._chunks: OrderedDict[int, list[McapRecord]] = OrderedDict()
        try:
            self._file = ChunkFile.open(path)
        except BadLog as error:
            raise BadInput(str(error)) from None
        try:
            self._places = self._scanned(progress)
            self._file.check_origin()
            if not self.scene.objects:
                raise BadInput(f"{path}: the log holds no scene; its beginning is damaged")
        except BadLog as error:
            self.close()
            raise BadInput(str(error)) from None
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
        """(time [s], object, message) with begin <= time <= end in order; topologies from before `begin` come first."""
        places = self._places
        times = places["time"] / 1e9
        wanted = ((times >= begin) | (places["kind"] == 0)) & (times <= end)
        for place in places[wanted]:
            record = self._chunk(int(place["offset"]))[int(place["number"])]
            assert isinstance(record, McapMessage)
            try:
                message = KINDS[place["kind"]][1].FromString(record.data)
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

    def _scanned(self, progress: Callable[[int], None]) -> np.ndarray:
        kinds = {name: number for number, (name, _) in enumerate(KINDS)}
        topics: dict[int, tuple[int, int]] = {}  # kind, object
        scene, places = -1, []
        for offset, records in self._file.scan(progress):
            self._file.check_origin()
            found = []
            for number, record in enumerate(records):
                if isinstance(record, Channel):
                    _, _, rest = record.topic.partition("/")
                    kind, _, name = rest.partition("/")
                    if kind == "scene":
                        scene = record.id
                    elif kind in kinds and name:
                        if name not in self.objects:
                            self.objects.append(name)
                        topics[record.id] = (kinds[kind], self.objects.index(name))
                elif isinstance(record, McapMessage) and record.channel_id == scene:
                    self.scene = _scene(self.path, record.data)
                elif isinstance(record, McapMessage) and record.channel_id in topics:
                    kind_number, object_number = topics[record.channel_id]
                    found.append((record.log_time, kind_number, number, offset, object_number, 0))
            places.append(np.array(found, PLACE))
        table = np.concatenate(places) if places else np.zeros(0, PLACE)
        return table[np.lexsort((np.arange(len(table)), table["kind"], table["time"]))]

    def _chunk(self, offset: int) -> list[McapRecord]:
        if offset not in self._chunks:
            while len(self._chunks) >= CHUNKS:
                self._chunks.popitem(last=False)
            self._chunks[offset] = self._file.chunk(offset)
        self._chunks.move_to_end(offset)
        return self._chunks[offset]


def _scene(path: Path, data: bytes) -> pb.Scene:
    try:
        return pb.Scene.FromString(data)
    except DecodeError:
        raise BadInput(f"{path}: the scene in the log cannot be read") from None
