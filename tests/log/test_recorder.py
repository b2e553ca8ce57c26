# SPDX-License-Identifier: MIT
"""Recorder -> reader: what goes in comes out, and trouble stays away from the caller."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from clients.errors import BadInput
from clients.log.reader import Log
from protocol import messages_pb2 as pb
from sim_server.errors import InputError
from sim_server.recording.recorder import Recorder
from tests.sample_run import DT, REST, TETS, object_step, positions, push, record, scene, state, topology, velocities


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_everything_comes_back(tmp_path: Path, compression: str) -> None:
    path = record(tmp_path / "run.mcap", 12, ("beam", "liver"), compression)
    with Log(path) as log:
        assert log.complete and log.notes == []
        assert log.scene is not None and list(log.scene.objects) == ["beam", "liver"]
        assert sorted(log.objects) == ["beam", "liver"]
        for name in log.objects:
            mesh = log.mesh(name, 1)
            np.testing.assert_array_equal(mesh.rest, REST)
            np.testing.assert_array_equal(mesh.tets, TETS)
            frames = list(log.frames(name))
            assert [frame.step for frame in frames] == list(range(13))
            for frame in frames:
                assert frame.time == frame.step * DT
                np.testing.assert_array_equal(frame.x, positions(frame.step))
                np.testing.assert_array_equal(frame.v, velocities(frame.step))
            scalars = log.scalars(name)
            assert scalars["iterations"].tolist() == [object_step(name, s).iterations for s in range(1, 13)]
            assert scalars["status"][3] == "max_iterations" and scalars["status"][0] == "converged"
            assert scalars["factor_step"].tolist() == [-1, -1, *range(1, 11)]
        assert log.object_log("beam").interactions == [(2 * DT, push("beam"))]
        assert log.object_log("liver").interactions == []


def test_log_is_self_describing(tmp_path: Path) -> None:
    """A reader that knows nothing of this program decodes it from the schema inside, with simulation and wall times."""
    began = time.time_ns()
    path = record(tmp_path / "run.mcap", 3)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(topics=["/step/beam"]))
    assert [m.decoded_message.step for m in found] == [1, 2, 3]
    assert [m.message.log_time for m in found] == [20_000_000, 40_000_000, 60_000_000]
    assert all(began <= m.message.publish_time <= time.time_ns() for m in found)
    assert found[0].schema is not None and found[0].schema.name == "warpfactor.ObjectStep"


def test_existing_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"run\.mcap: the file exists"):
        Recorder(path)
    assert path.read_text() == "precious"
    with Recorder(path, overwrite=True) as recorder:
        recorder.scene(scene([]))
    with Log(path) as log:
        assert log.complete


@pytest.mark.parametrize("place", ["missing/run.mcap", "."])
def test_unwritable_place_is_refused(tmp_path: Path, place: str) -> None:
    with pytest.raises(InputError, match=str(tmp_path)):
        Recorder(tmp_path / place)


def test_unknown_compression_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="allowed are lz4, zstd, none"):
        Recorder(tmp_path / "run.mcap", "gzip")  # type: ignore[arg-type]
    assert not (tmp_path / "run.mcap").exists()


def test_full_disk_stops_the_recording_only(caplog: pytest.LogCaptureFixture) -> None:
    messages: list[str] = []
    recorder = Recorder("/dev/full", overwrite=True, report=messages.append)
    big = topology("beam", rest=np.random.default_rng(1).random((100_000, 3)))  # more than one chunk
    for _ in range(5):
        recorder.topology(big)
    recorder.close()
    assert len(messages) == 1 and "No space left on device" in messages[0] and "/dev/full" in messages[0]
    assert recorder.failure == messages[0]
    recorder.step(object_step("beam", 1))  # feeding on does nothing and raises nothing
    recorder.close()


class _StuckFile:
    """Stands for a disk that takes nothing until told."""

    regular = closed = False

    def __init__(self) -> None:
        self.go = threading.Event()
        self.topics: list[str] = []
        self.notes: dict[str, str] = {}
        self.size = 0

    def write(self, topic: str, *_: object) -> None:
        assert self.go.wait(30)
        self.topics.append(topic)

    def flush(self) -> None:
        pass

    def check_exists(self) -> None:
        pass

    def finish(self, notes: dict[str, str]) -> int:
        self.notes = notes
        return self.size


@pytest.fixture
def stuck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> _StuckFile:
    file = _StuckFile()
    monkeypatch.setattr("sim_server.recording.pieces.McapFile", lambda *_: file)
    return file


def test_slow_disk_drops_frames_and_keeps_steps(stuck: _StuckFile) -> None:
    recorder = Recorder("slow.mcap", frame_bytes=2_000)
    for step in range(1, 101):
        recorder.state(state("beam", step))
        recorder.step(object_step("beam", step))
    assert recorder.dropped > 80 and recorder.lost == 0
    stuck.go.set()
    recorder.close()
    assert stuck.topics.count("/step/beam") == 100
    assert stuck.topics.count("/state/beam") == 100 - recorder.dropped
    assert stuck.notes == {"frames_dropped": str(recorder.dropped), "records_lost": "0", "records_thinned": "0"}


def test_stuck_disk_is_bounded_in_memory(stuck: _StuckFile) -> None:
    messages: list[str] = []
    recorder = Recorder("stuck.mcap", frame_bytes=1_000, total_bytes=5_000, report=messages.append)
    for step in range(1, 501):
        recorder.step(object_step("beam", step))
    assert recorder.lost > 400 and len(messages) == 1 and "too slow" in messages[0]
    stuck.go.set()
    recorder.close()
    assert len(stuck.topics) == 500 - recorder.lost


def test_blocking_caller_loses_nothing(stuck: _StuckFile) -> None:
    recorder = Recorder("slow.mcap", frame_bytes=1_000, total_bytes=2_000)
    threading.Timer(0.2, stuck.go.set).start()
    for step in range(200):
        recorder.state(state("beam", step), block=True)
    recorder.close()
    assert recorder.dropped == recorder.lost == 0
    assert len(stuck.topics) == 200


def test_a_state_that_blew_up_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.topology(topology("beam"))
        bad = state("beam", 3)
        bad.x = np.full_like(REST, np.nan).tobytes()
        bad.time = float("nan")
        recorder.state(bad)
    with Log(path) as log:
        assert np.isnan(log.frame("beam", -1).x).all()


CHILD = """
import sys, time
from sim_server.recording.recorder import Recorder
from tests.sample_run import *
recorder = Recorder(sys.argv[1])
recorder.scene(scene(["beam"]))
recorder.topology(topology("beam"))
step = 0
while True:
    recorder.state(state("beam", step))
    step += 1
    recorder.step(object_step("beam", step))
    time.sleep(0.001)
"""


def _frames_when_readable(path: Path, more_than: int) -> int:
    """Frames in a log that somebody is writing, as soon as they are more than a number."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            with Log(path) as log:
                count = len(log.object_log("beam").frames)
        except BadInput:  # nothing flushed so far
            count = 0
        if count > more_than:
            return count
        time.sleep(0.1)
    raise AssertionError(f"never more than {more_than} frames in {path}")


def test_a_quiet_recording_reaches_the_disk_without_being_closed(tmp_path: Path) -> None:
    """Far less than a chunk, and nothing comes after it: the timed flush alone writes it."""
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.state(state("beam", 0))
        assert _frames_when_readable(path, 0) == 1


@pytest.mark.system
def test_log_of_a_killed_process_is_readable_to_the_last_flush(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], cwd=Path(__file__).parents[2])
    try:
        first = _frames_when_readable(path, 0)
        second = _frames_when_readable(path, first)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    with Log(path) as log:
        assert not log.complete and "without an end mark" in log.notes[0]
        recorded = [frame.step for frame in log.frames("beam")]
        assert len(recorded) >= second > first
        assert recorded == list(range(len(recorded)))
        assert log.mesh("beam", 1).rest.shape == (5, 3)
        assert isinstance(log.scene, pb.Scene)
