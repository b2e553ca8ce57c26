# SPDX-License-Identifier: MIT
"""Messages of a log by kind and object, above the chunks of its file (log_chunks.py)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Self

from mcap.records import Channel, McapRecord, Message

from protocol.log_chunks import ChunkFile

CHUNKS = 8  # kept unpacked, about 1 MiB each


class LogMessage(NamedTuple):
    """A message of the topic /KIND or /KIND/OBJECT, not decoded.

    offset: of its chunk [bytes]. number: of the message among the records of the chunk.
    """

    topic: str
    kind: str
    object: str
    time: int  # ns
    data: bytes
    offset: int
    number: int


@dataclass
class LogFile(ChunkFile):
    """The messages of one log; a context manager."""

    _chunks: OrderedDict[int, list[McapRecord]] = field(default_factory=OrderedDict)  # by offset, the last used last

    def messages(self, progress: Callable[[int], None] = lambda _: None) -> Iterator[LogMessage]:
        """Yields the messages in file order; `progress` gets the offset reached.

        Raises BadLog before the first message unless the file is a log of this protocol version.
        """
        topics: dict[int, tuple[str, str, str]] = {}
        for offset, records in self.scan(progress):
            self.check_origin()
            for number, record in enumerate(records):
                if isinstance(record, Channel):
                    _, kind, name = [*record.topic.split("/", 2), "", ""][:3]
                    topics[record.id] = record.topic, kind, name
                elif isinstance(record, Message):
                    topic = topics.get(record.channel_id, ("", "", ""))
                    yield LogMessage(*topic, record.log_time, record.data, offset, number)
        self.check_origin()

    def data(self, offset: int, number: int) -> bytes:
        """Returns the data of a message that `messages` has yielded."""
        if offset not in self._chunks:
            while len(self._chunks) >= CHUNKS:
                self._chunks.popitem(last=False)
            self._chunks[offset] = self.chunk(offset)
        self._chunks.move_to_end(offset)
        record = self._chunks[offset][number]
        assert isinstance(record, Message)
        return record.data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
