# SPDX-License-Identifier: MIT
"""Logs that are cut off, damaged, foreign or hostile: read as far as they go, or refused in one sentence."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import Writer

from clients.errors import BadInput
from clients.log import scalars
from clients.log.reader import Log
from protocol import log_chunks
from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL
from sim_server.recording.mcap_file import McapFile
from tests.sample_run import object_step, positions, record, state, topology


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    """A log of several chunks."""
    path = tmp_path / "whole.mcap"
    file = McapFile(path, "lz4", overwrite=False)
    for step in range(40):
        for topic, message in (
            ("/topology/beam", topology("beam")),
            ("/state/beam", state("beam", step)),
            ("/step/beam", object_step("beam", step + 1)),
        ):
            if topic != "/topology/beam" or step == 0:
                file.write(topic, type(message), step, step, step, message.SerializeToString())
        if step % 5 == 4:
            file.flush()
    file.finish({})
    return path.read_bytes()


@pytest.mark.slow
def test_cut_anywhere_reads_as_far_as_it_goes(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    counts = []
    for cut in [*range(0, 120), *range(120, len(whole), 61), len(whole) - 1]:
        path.write_bytes(whole[:cut])
        try:
            log = Log(path)
        except BadInput as error:
            assert "cut.mcap" in str(error)
            counts.append(0)
            continue
        with log:
            frames = list(log.frames("beam")) if log.objects else []
            assert [frame.step for frame in frames] == list(range(len(frames)))
            for frame in frames:
                np.testing.assert_array_equal(frame.x, positions(frame.step))
            counts.append(len(frames))
            assert len(frames) % 5 == 0  # whole chunks
            assert log.notes or len(frames) == 40
    assert counts == sorted(counts) and counts[-1] == 40 and set(counts) >= {0, 5, 20, 35}


@pytest.mark.slow
def test_flipped_bytes_never_raise_anything_else(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flipped.mcap"
    random = np.random.default_rng(3)
    for position in random.integers(8, len(whole), 300):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        try:
            with Log(path) as log:
                for frame in log.frames("beam") if log.objects else ():
                    np.testing.assert_array_equal(frame.x, positions(frame.step))  # damaged chunks are not believed
        except BadInput as error:
            assert "flipped.mcap" in str(error)


def test_a_damaged_chunk_is_left_out_and_said(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "damaged.mcap"
    damaged = bytearray(whole)
    at = [i for i in range(len(whole)) if whole.startswith(b"\x03\x00\x00\x00lz4", i)][3] + 40
    damaged[at] ^= 0xFF
    path.write_bytes(damaged)
    with Log(path) as log:
        steps = [frame.step for frame in log.frames("beam")]
        assert len(steps) == 35 and set(range(40)) - set(steps) == set(range(15, 20))
        assert not log.complete and len(log.notes) == 1 and "is damaged and left out" in log.notes[0]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "an empty file"),
        (b"hello, this is a text file", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "nothing readable"),
        (b"\x89MCAP0\r\n" + bytes(1000), "nothing readable"),
        (b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 1 << 60), "nothing readable"),
    ],
)
def test_no_log_at_all(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=rf"x\.mcap: {said}"):
        Log(path)


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"gone\.mcap: cannot be read: No such file"):
        Log(tmp_path / "gone.mcap")
    with pytest.raises(BadInput, match="cannot be read: Is a directory"):
        Log(tmp_path)


def test_foreign_mcap_file(tmp_path: Path) -> None:
    path = tmp_path / "ros.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.finish()
    with pytest.raises(BadInput, match="not a log of sim-server"):
        Log(path)


def test_another_protocol_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_server.recording.mcap_file.PROTOCOL", PROTOCOL + 41)
    path = record(tmp_path / "new.mcap", 1)
    with pytest.raises(
        BadInput, match=f"protocol version {PROTOCOL + 41}; this program reads versions 1 to {PROTOCOL}"
    ):
        Log(path)


def test_malformed_messages_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    file = McapFile(path, "none", overwrite=False)
    short = state("beam", 1)
    short.x = short.x[:-1]
    wild = topology("beam")
    wild.tets = np.array([[0, 1, 2, 99]], np.int32).tobytes()
    huge = state("beam", 2)
    huge.nodes = 1 << 31
    for topic, message in (
        ("/state/beam", short),
        ("/topology/beam", wild),
        ("/state/beam", huge),
        ("/state/beam", state("beam", 3)),
    ):
        file.write(topic, type(message), 0, 0, 0, message.SerializeToString())
    file.write("/step/beam", type(object_step("beam", 1)), 0, 0, 0, b"\xff\xff\xff")
    file.finish({})
    with Log(path) as log:
        assert [frame.step for frame in log.frames("beam")] == [3]
        assert "4 malformed messages left out" in log.notes[0]
        with pytest.raises(BadInput, match="mesh of object 'beam', epoch 1, is not in the log"):
            log.mesh("beam", 1)
        with pytest.raises(BadInput, match="no object 'liver'; objects in the log: beam"):
            log.object_log("liver")


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_chunk_that_unpacks_to_more_than_it_says(compression: str) -> None:
    """Not a byte more than announced is kept, and no more than RECORD_LIMIT is announced."""
    plain = bytes(50_000_000)
    packed = lz4.frame.compress(plain) if compression == "lz4" else zstandard.compress(plain)
    bomb = Chunk(compression, packed, 0, 0, zlib.crc32(b""), 100)
    with pytest.raises(ValueError, match="101 bytes instead of 100"):
        log_chunks.unpack(bomb)
    bomb.uncompressed_size = log_chunks.RECORD_LIMIT + 1
    with pytest.raises(ValueError, match="at most"):
        log_chunks.unpack(bomb)


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("content", ["zeros", "many empty records", "a record beyond the end"])
def test_what_holds_no_records_is_not_unpacked_to_its_end(compression: str, content: str, tmp_path: Path) -> None:
    """A chunk of 128 MiB in some kB: refused after its first part, the rest of the log is read."""
    size = 1 << 27
    first = {
        "zeros": b"",
        "many empty records": (b"\x03" + bytes(8)) * (log_chunks.CHUNK_RECORDS + 1),
        "a record beyond the end": b"\x05" + struct.pack("<Q", 1 << 40),
    }[content]
    made = {"lz4": lz4.frame.LZ4FrameCompressor, "zstd": zstandard.ZstdCompressor().compressobj}
    compressor: Any = made[compression]()
    packed = compressor.begin() if compression == "lz4" else b""
    for piece in (first, *[bytes(1 << 22)] * 32):
        packed += compressor.compress(piece[: size - len(first)] if piece is not first else piece)
    bomb = Chunk(compression, packed + compressor.flush(), 0, 0, 0, size + len(first))
    builder = RecordBuilder()
    bomb.write(builder)
    good = record(tmp_path / "good.mcap", 3).read_bytes()
    end = good.index(b"\x0f" + struct.pack("<Q", 4))  # DATA_END
    path = tmp_path / "bomb.mcap"
    path.write_bytes(good[:end] + builder.end() + good[end:])
    tracemalloc.start()
    with Log(path) as log:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert [frame.step for frame in log.frames("beam")] == [0, 1, 2, 3]
        assert len(log.notes) == 1 and "is damaged and left out (no records from byte" in log.notes[0]
    assert peak < 48 << 20


def test_names_of_readings_and_reactions_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first ones are kept, whatever comes later; a reaction may have a point in some steps alone."""
    monkeypatch.setattr(scalars, "MOST_READINGS", 3)
    monkeypatch.setattr(scalars, "MOST_REACTIONS", 2)
    path = tmp_path / "run.mcap"
    file = McapFile(path, "none", overwrite=False)
    for number in range(1, 5):
        step = object_step("beam", number)
        for of in ("always", *(f"{number}/{k}" for k in range(2))):
            step.readings.add(of=of, quantity="tension", value=number)
        reaction = step.reactions.add(object="wall", force=pb.Vector(y=number))
        if number > 2:
            reaction.point.x = 7
        step.reactions.add(grab=number, force=pb.Vector(x=1))
        file.write("/step/beam", type(step), 0, 0, 0, step.SerializeToString())
    file.finish({})
    with Log(path) as log:
        found = log.scalars("beam")
        assert [name for name in found if name.startswith("reading/")] == [
            "reading/always/tension", "reading/1/0/tension", "reading/1/1/tension",
        ]  # fmt: skip
        np.testing.assert_array_equal(found["reading/always/tension"], [1, 2, 3, 4])
        np.testing.assert_array_equal(found["reading/1/1/tension"], [1, np.nan, np.nan, np.nan])
        assert {name.split("/")[1] for name in found if name.startswith("reaction/")} == {"wall", "grab:1"}
        np.testing.assert_array_equal(found["reaction/wall/force_y"], [1, 2, 3, 4])
        np.testing.assert_array_equal(found["reaction/wall/point_x"], [np.nan, np.nan, 7, 7])
        np.testing.assert_array_equal(found["reaction/grab:1/force_x"], [1, 0, 0, 0])
        assert [note.removeprefix(f"{path}: object 'beam': ") for note in log.notes] == [
            "more than 2 names of reactions: 3 values of further ones are left out",
            "more than 3 names of readings: 6 values of further ones are left out",
        ]


def test_dropped_frames_are_told(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    file = McapFile(path, "lz4", overwrite=False)
    file.write("/topology/beam", type(topology("beam")), 0, 0, 0, topology("beam").SerializeToString())
    file.finish({"frames_dropped": "12", "records_lost": "0"})
    with Log(path) as log:
        assert log.complete
        assert log.notes == [f"{path}: the recorder could not keep up: frames dropped: 12"]
