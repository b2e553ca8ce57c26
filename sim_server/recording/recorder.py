# SPDX-License-Identifier: MIT
"""Writes the messages of a run to a log, MCAP files that describe themselves.

The caller serializes a message and appends it to a queue; one thread compresses and writes. A file is a sequence of
complete chunks, flushed every FLUSH_SECONDS, so that after `kill -9` it is readable up to the last flush.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

from google.protobuf.message import Message

from protocol import messages_pb2 as pb
from sim_server.errors import InputError
from sim_server.recording.object_steps import Encoded
from sim_server.recording.pieces import Pieces, Record
from sim_server.recording.rotation import Rotation

FLUSH_SECONDS = 1.0  # age of the oldest record that a crash may lose
LOOK_SECONDS = 0.5  # between two looks whether the file is still there, and whether there is room for a new one
LONGEST_PAUSE = 30.0  # between two attempts to begin a new file, if there is room and it fails all the same
FRAME_BYTES = 64 << 20  # of all records that wait for the disk; above it frames are dropped
TOTAL_BYTES = 256 << 20  # the same; above it all records are lost

SEQUENCE = 0xFFFFFFFF  # bits of a number in MCAP files

Compression = Literal["lz4", "zstd", "none"]

log = logging.getLogger(__name__)


class Recorder:
    """Writes scene, topologies, states, steps, interactions and obstacles to an MCAP file from a thread of its own.

    Messages are stored under /scene, /topology/OBJECT, /state/OBJECT, /step/OBJECT, /interaction/OBJECT, /touch,
    /factor/OBJECT, /obstacle/OBSTACLE, /pose/OBSTACLE, /targets, /parameters, /resets and /checkpoint with `log_time` =
    simulation time and `publish_time` = wall clock, both in ns.

    Appending does not wait for the disk unless `block` is true (for runs without a pace). While more than FRAME_BYTES
    wait, states are dropped and counted in `dropped`; other records are kept up to TOTAL_BYTES, and counted in `lost`
    beyond that. Both numbers are written at the end of the file. After a disk error, or the file's removal, messages
    are lost and counted until there is room for a new file, in which the recording goes on; both is reported through
    `report`, and `failure` says what is missing. rotation: when a new file is begun else.

    Raises InputError if the file cannot be created, if it is there already and not to be overwritten, if another
    process records to it, or for an unknown compression.
    """

    def __init__(
        self,
        path: str | Path,
        compression: Compression = "lz4",
        *,
        overwrite: bool = False,
        report: Callable[[str], None] = log.error,
        frame_bytes: int = FRAME_BYTES,
        total_bytes: int = TOTAL_BYTES,
        rotation: Rotation = Rotation(),  # noqa: B008  frozen
    ) -> None:
        self.path = Path(path)
        self.dropped = 0  # frames
        self.lost = 0  # records of other kinds
        self.thinned = 0  # step records that were left out because it was behind, as the caller counts them
        self.written = 0  # records handed to the file
        self.bytes_written = 0
        self.failure = ""  # why the log is not whole
        self.broken = False  # it is not written now
        self._report = report
        self._frame_bytes, self._total_bytes = frame_bytes, total_bytes
        self._waiting: deque[Record] = deque()
        self._waiting_bytes = 0
        self._time = 0  # ns of simulation, newest seen; stamps what has no time of its own
        self._closing = False
        self._changed = threading.Condition()
        self._missing = 0  # records since it broke off
        self._pieces = Pieces(self.path, compression, overwrite, rotation)
        self._thread = threading.Thread(target=self._write_all, name="recorder", daemon=True)
        self._thread.start()

    def scene(self, message: pb.Scene, block: bool = False) -> None:
        self._append("/scene", message, 0, 0, block, repeat="scene")

    def topology(
        self, message: pb.Topology, block: bool = False, time: float | None = None, again: bool = False
    ) -> bool:  # fmt: skip
        """Appends a mesh, or what a cut changes of it. time: from which it holds [s of simulation]; None: now.

        Returns False if there is no room for it. again: the caller sends it again then, so that it is not lost
        """
        stamp = self._time if time is None else self._stamp(time)
        topic, sequence = f"/topology/{message.header.object}", message.header.epoch + message.cut
        repeat = topic if message.tets or not message.cut else f"{topic}/cut"
        return self._append(topic, message, stamp, sequence, block, counts=not again, repeat=repeat)

    def obstacle(self, message: pb.Obstacle, block: bool = False) -> None:
        topic = f"/obstacle/{message.header.object}"
        self._append(topic, message, self._time, 0, block, repeat=topic)

    def pose(self, message: pb.ObstaclePose, block: bool = False) -> None:
        """Appends where an obstacle is at a frame."""
        self._append(f"/pose/{message.header.object}", message, self._stamp(message.time), message.step, block)

    def targets(self, message: pb.ObstacleTargets, time: float, block: bool = False) -> None:
        """Appends where clients want obstacles to be, as the loop works with it from `time` [s of simulation] on."""
        self._append("/targets", message, self._stamp(time), message.step, block)

    def state(self, message: pb.State, block: bool = False) -> None:
        """Appends a frame; the only kind that is dropped when the disk falls behind."""
        self._append(f"/state/{message.header.object}", message, self._stamp(message.time), message.step, block)

    def step(self, message: pb.ObjectStep, block: bool = False) -> None:
        self._append(f"/step/{message.header.object}", message, self._stamp(message.time), message.step, block)

    def steps(self, steps: Sequence[Encoded], block: bool = False) -> None:
        """Appends steps that are serialized already."""
        self._put_all("step", pb.ObjectStep, steps, block)

    def states(self, states: Sequence[Encoded], block: bool = False) -> None:
        """Appends frames likewise."""
        self._put_all("state", pb.State, states, block)

    def _put_all(self, channel: str, kind: type[Message], messages: Sequence[Encoded], block: bool) -> None:
        now = time.time_ns()
        self._put(
            [
                Record(f"/{channel}/{m.object}", kind, self._stamp(m.time), now, m.step & SEQUENCE, m.data)
                for m in messages
            ],
            block,
        )

    def interaction(self, message: pb.Interaction, time: float, block: bool = False) -> None:
        """Appends a push or grab that took effect at `time` [s of simulation]."""
        self._append(f"/interaction/{message.object}", message, self._stamp(time), message.id, block)

    def touch_set(self, message: pb.TouchSet, time: float, block: bool = False) -> None:
        """Appends the interactions that the loop works with from `time` [s of simulation] on."""
        self._append("/touch", message, self._stamp(time), message.step, block)

    def parameters(self, message: pb.ParameterSet, time: float, block: bool = False) -> None:
        """Appends parameters of the scene that the loop works with from `time` [s of simulation] on."""
        self._append("/parameters", message, self._stamp(time), message.step, block)

    def reset(self, message: pb.Reset, time: float, block: bool = False) -> None:
        """Appends that an object, or all, were put back to the start at `time` [s of simulation]."""
        self._append("/resets", message, self._stamp(time), message.step, block)

    def checkpoint(self, message: pb.Checkpoint, time: float) -> None:
        """Appends where the run begins, `time` [s of simulation] after the start of the scene."""
        self._append("/checkpoint", message, self._stamp(time), message.step, block=True)

    def factor(self, message: pb.FactorUse, block: bool = False) -> None:
        """Appends the origin of a factor that the loop was given."""
        self._append(f"/factor/{message.header.object}", message, self._time, message.step, block)

    def close(self) -> None:
        """Writes the records that wait and the index of the file; further calls do nothing."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stamp(self, seconds: float) -> int:
        if math.isfinite(seconds) and 0 <= seconds < 1e10:  # a solve that blew up must not stop the log
            self._time = round(seconds * 1e9)
        return self._time

    def skip_frame(self) -> None:
        """Counts a frame as dropped that is not appended, as its mesh is not in the log yet."""
        with self._changed:
            self.dropped += 1

    def _append(
        self, topic: str, message: Message, log_time: int, sequence: int, block: bool, counts: bool = True,
        repeat: str = "",
    ) -> bool:  # fmt: skip
        """Returns False if there is no room; counts: it is dropped or lost then. True after the end of the log, or
        while it is broken: what each file begins with is kept for the next one."""
        now, number, data = time.time_ns(), sequence & SEQUENCE, message.SerializeToString()
        return self._put([Record(topic, type(message), log_time, now, number, data, repeat)], block, counts)

    def _put(self, records: Sequence[Record], block: bool, counts: bool = True) -> bool:
        whole = True
        with self._changed:
            for record in records:
                if block and not self._may_append(record):
                    self._changed.notify_all()
                    self._changed.wait_for(partial(self._may_append, record))
                if self._closing:
                    break
                if self.broken:
                    self._miss(record)
                elif not self._fits(record, self._limit(record)):
                    whole = False
                    if counts:
                        self._count_dropped(record)
                else:
                    self._waiting.append(record)
                    self._waiting_bytes += len(record.data)
            self._changed.notify_all()
        return whole

    def _limit(self, record: Record) -> int:
        return self._frame_bytes if record.kind is pb.State else self._total_bytes

    def _may_append(self, record: Record) -> bool:
        return self._fits(record, self._frame_bytes) or self.broken or self._closing

    def _miss(self, record: Record) -> None:
        """Counts a record that came while the log was broken."""
        self._pieces.repeated.note(record)
        self._missing += 1
        if record.kind is pb.State:
            self.dropped += 1
        else:
            self.lost += 1

    def _fits(self, record: Record, limit: int) -> bool:
        return not self._waiting or self._waiting_bytes + len(record.data) <= limit

    def _count_dropped(self, record: Record) -> None:
        if record.kind is pb.State:
            self.dropped += 1
            return
        self.lost += 1
        if self.lost == 1:
            self._report(f"{self.path}: the disk is too slow, {self._total_bytes >> 20} MiB wait: records are lost")

    def _write_all(self) -> None:
        try:
            self._write_pieces()
        finally:
            self._pieces.close()

    def _write_pieces(self) -> None:
        while True:
            try:
                self._write_until_closed()
                self._pieces.finish(self._notes())
                return
            except Exception as error:  # whatever it is, the simulation goes on
                self._break_off(error)
            if not self._go_on():
                return

    def _notes(self) -> dict[str, int]:
        return {"frames_dropped": self.dropped, "records_lost": self.lost, "records_thinned": self.thinned}

    @property
    def behind(self) -> bool:
        """True while so much waits for the disk that frames will be dropped soon."""
        return self._waiting_bytes > self._frame_bytes // 2

    def _break_off(self, error: Exception) -> None:
        """Leaves the file; records are lost from now on."""
        self._pieces.abandon()
        with self._changed:
            why = getattr(error, "strerror", None) or error
            self.failure = f"{self._pieces.path}: recording stopped after {self.written} records: {why}"
            self.broken, self._missing = True, 0
            for record in self._waiting:
                self._miss(record)
            self._waiting.clear()
            self._waiting_bytes = 0
            self._changed.notify_all()
        self._report(self.failure)

    def _go_on(self) -> bool:
        """Waits until there is room, and begins a new file; returns False if the recorder is closed before."""
        pause = LOOK_SECONDS
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._closing, pause):
                    return False
                first = self._pieces.repeated.records()
            if not self._pieces.may_go_on(first):
                continue
            try:
                self._pieces.go_on(first)  # not under the lock: nobody who appends waits for the disk
            except (OSError, InputError):
                pause = min(2 * pause, LONGEST_PAUSE)
                continue
            with self._changed:
                self._waiting.extend(r for r in self._pieces.repeated.records() if r not in first)  # came meanwhile
                self._waiting_bytes = sum(len(r.data) for r in self._waiting)
                then = f"it goes on in {self._pieces.path}, {self._missing} records are missing"
                self.failure += f"; {then}"
                self.broken = False
            self._report(f"{self.path}: {then}")
            return True

    def _write_until_closed(self) -> None:
        flushed = time.monotonic()
        unflushed = False
        while True:
            batch, closing = self._next_batch(LOOK_SECONDS)
            for record in batch:
                self._pieces.write(record)
                self.written += 1
            self.bytes_written = self._pieces.bytes_written
            unflushed = unflushed or bool(batch)
            now = time.monotonic()
            if unflushed and now - flushed >= FLUSH_SECONDS:
                self._pieces.flush()
                flushed, unflushed = now, False
            if closing and not batch:
                return
            self._pieces.look(self._notes())

    def _next_batch(self, timeout: float) -> tuple[list[Record], bool]:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing, timeout)
            batch: list[Record] = []
            size = 0
            while self._waiting and size < 1 << 20:  # a chunk at most, so that the flush stays on time
                batch.append(self._waiting.popleft())
                size += len(batch[-1].data)
            self._waiting_bytes -= size
            self._changed.notify_all()
            return batch, self._closing
