# SPDX-License-Identifier: MIT
"""Logs in several files: rotation, budgets, and what becomes of a log when the disk is full or its file removed."""

import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clients.errors import BadInput
from clients.log.reader import Log
from protocol import messages_pb2 as pb
from protocol.log_chunks import BadLog
from protocol.log_file import LogFile
from protocol.log_pieces import later_pieces, size_of_log
from sim_server.errors import InputError
from sim_server.recording.pieces import Pieces
from sim_server.recording.recorder import Recorder
from sim_server.recording.rotation import Kept, Rotation

NODES = 20
TETS = np.arange(4 * 5, dtype="<i4").reshape(5, 4)


def topology() -> pb.Topology:
    rest = np.random.default_rng(3).random((NODES, 3))
    return pb.Topology(
        header=pb.Header(object="beam", epoch=1), nodes=NODES, rest=rest.astype("<f8").tobytes(), tets=TETS.tobytes(),
        triangles=TETS[:, :3].astype("<i4").tobytes(),
    )  # fmt: skip


def begin(recorder: Recorder) -> None:
    recorder.scene(pb.Scene(name="s.toml", resolved="{}", dt=0.1, objects=["beam"]))
    recorder.topology(topology())


def steps(recorder: Recorder, first: int, last: int, frame: int = 20_000) -> None:
    """Steps first to last, each with a frame of random numbers, so that nothing is compressed away."""
    random = np.random.default_rng(first)
    for k in range(first, last + 1):
        header = pb.Header(object="beam", epoch=1)
        recorder.step(pb.ObjectStep(header=header, step=k, time=0.1 * k, iterations=k % 7), block=True)
        x = random.random((NODES, 3)).astype("<f8").tobytes()
        recorder.state(pb.State(header=header, step=k, time=0.1 * k, nodes=NODES, x=x, v=x), block=True)
        # What makes the log large: a client's name of random bytes.
        recorder.interaction(pb.Interaction(object="beam", held=random.bytes(frame)), 0.1 * k, block=True)


def on_disk(path: Path) -> int:
    """Messages that a reader finds while the log is being written."""
    try:
        with LogFile.open(path) as log:
            return sum(1 for _ in log.messages())
    except BadLog:  # nothing of it yet
        return 0


def until(holds: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_pieces_together_are_the_log_and_each_can_be_read_alone(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole.mcap", tmp_path / "parts.mcap"
    for path, rotation in ((whole, Rotation()), (parts, Rotation(bytes=1.5e6))):
        with Recorder(path, rotation=rotation) as recorder:
            begin(recorder)
            steps(recorder, 1, 400)
    pieces = [piece for _, piece in later_pieces(parts)]
    assert len(pieces) >= 3 and later_pieces(whole) == []
    with LogFile.open(whole) as a, LogFile.open(parts) as b:
        one, other = list(a.messages()), list(b.messages())
        assert [m[:5] for m in one] == [m[:5] for m in other]
        assert b.whole and b.notes() == []
        for message in other[::97]:
            assert b.data(message.offset, message.number) == message.data
    found = []
    for piece in (parts, *pieces):
        alone = tmp_path / f"alone-{piece.name}"
        alone.write_bytes(piece.read_bytes())
        with Log(alone) as log:
            assert log.complete and log.scene is not None and log.scene.name == "s.toml"
            frames = list(log.frames("beam"))
            assert len(next(iter(log.objects["beam"].meshes.values())).tets) == len(TETS)
            found += [frame.step for frame in frames]
    assert found == list(range(1, 401))


def test_a_budget_removes_the_oldest_files(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    rotation = Rotation.of_options(["1MB"], "4MB")
    with Recorder(path, rotation=rotation) as recorder:
        begin(recorder)
        for k in range(10):
            steps(recorder, 1 + 50 * k, 50 * (k + 1))
            assert size_of_log(path) < 4e6 + 3e6  # and what is being written
    assert not path.exists()
    assert size_of_log(path) < 4e6 + 3e6
    with Log(path) as log:
        seen = [frame.step for frame in log.frames("beam")]
        assert seen == list(range(seen[0], 501)) and seen[0] > 1, "the newest are there, without a gap"


class Due(Rotation):
    """A new file is due when a test says so."""

    now = False

    def due(self, size: int, age: float) -> bool:
        return Due.now


@pytest.fixture
def due(monkeypatch: pytest.MonkeyPatch) -> Due:
    monkeypatch.setattr(Due, "now", False)
    monkeypatch.setattr("sim_server.recording.recorder.LOOK_SECONDS", 0.02)
    return Due()


def in_pieces(path: Path, count: int, due: Due) -> None:
    """Writes a log of as many pieces, each with a step and a frame of its number."""
    with Recorder(path, rotation=due) as recorder:
        begin(recorder)
        for k in range(1, count + 1):
            steps(recorder, k, k, frame=100)
            until(lambda k=k: recorder.written == 2 + 3 * k)
            Due.now = k < count
            until(lambda k=k: len(later_pieces(path)) == min(k, count - 1))
            Due.now = False


def test_time_begins_a_new_file_and_an_idle_log_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, due: Due) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, rotation=Rotation(seconds=0.3)) as recorder:
        begin(recorder)
        until(lambda: later_pieces(path))
    path = tmp_path / "idle.mcap"
    looks = []
    with Recorder(path, rotation=due) as recorder:
        keep = Kept.keep_budget
        monkeypatch.setattr(Kept, "keep_budget", lambda kept, size: looks.append(keep(kept, size)))
        begin(recorder)
        until(lambda: recorder.written == 2)
        Due.now = True
        until(lambda: len(later_pieces(path)) == 1)
        done = len(looks)
        until(lambda: len(looks) > done + 5)
        assert len(later_pieces(path)) == 1, "nothing came: nothing is begun"
        Due.now = False
        steps(recorder, 1, 1)
        until(lambda: recorder.written == 5)
        Due.now = True
        until(lambda: len(later_pieces(path)) == 2)


def test_a_log_of_many_pieces_needs_few_open_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, due: Due) -> None:
    path = tmp_path / "run.mcap"
    in_pieces(path, 9, due)
    monkeypatch.setattr("protocol.log_file.OPEN", 3)

    def held() -> int:
        links = (os.path.realpath(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd"))
        return sum(link.startswith(str(tmp_path)) for link in links)

    with Log(path) as log:
        assert held() <= 4
        assert log.complete and [frame.step for frame in log.frames("beam")] == list(range(1, 10))
        assert [log.frame("beam", k).step for k in (8, 0, 7, 1)] == [9, 1, 8, 2]
        assert held() <= 4
    assert held() == 0


def test_a_piece_that_is_missing_between_others_is_told(tmp_path: Path, due: Due) -> None:
    path = tmp_path / "run.mcap"
    in_pieces(path, 5, due)
    later_pieces(path)[1][1].unlink()
    with Log(path) as log:
        assert not log.complete and [frame.step for frame in log.frames("beam")] == [1, 2, 4, 5]
        (note,) = log.notes
        assert "run.0004.mcap: before it piece 3 of the log is missing" in note
    with Log(later_pieces(path)[0][1]) as log:
        assert log.complete, "a piece that is opened alone has none before it"


def test_pieces_that_go_while_a_log_is_opened_are_not_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, due: Due
) -> None:
    """As a recorder that keeps a budget removes them."""
    path = tmp_path / "run.mcap"
    in_pieces(path, 4, due)

    def listed(of: Path) -> list[tuple[int, Path]]:
        found = later_pieces(of)
        of.unlink()
        found[0][1].unlink()
        return found

    monkeypatch.setattr("protocol.log_file.later_pieces", listed)
    with Log(path) as log:
        assert log.complete and [frame.step for frame in log.frames("beam")] == [3, 4]


def test_a_file_that_is_replaced_while_it_is_read_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, due: Due
) -> None:
    path = tmp_path / "run.mcap"
    in_pieces(path, 3, due)
    monkeypatch.setattr("protocol.log_file.CHUNKS", 1)
    with Log(path) as log:
        with Recorder(path, overwrite=True) as recorder:  # the same file, begun anew
            begin(recorder)
        with pytest.raises(BadInput, match=r"run\.mcap.*the file was changed or removed since it was opened"):
            log.frame("beam", 0)
        assert log.frame("beam", 1).step == 2, "removed, and still open"


def test_what_a_damaged_beginning_repeats_costs_no_message(tmp_path: Path, due: Due) -> None:
    path = tmp_path / "run.mcap"
    in_pieces(path, 3, due)
    second = later_pieces(path)[0][1]
    with LogFile.open(second) as alone:
        offset = next(alone.messages()).offset
    data = bytearray(second.read_bytes())
    data[offset + 60] ^= 0xFF
    second.write_bytes(data)
    with Log(path) as log:
        assert [frame.step for frame in log.frames("beam")] == [1, 2, 3]
        assert sorted(log.scalars("beam")["step"]) == [1, 2, 3]
        assert not log.complete and "is damaged and left out" in log.notes[0]


def test_a_file_that_is_moved_away_is_whole_there(tmp_path: Path, due: Due) -> None:
    path, away = tmp_path / "run.mcap", tmp_path / "away.mcap"
    with Recorder(path, rotation=due) as recorder:
        begin(recorder)
        steps(recorder, 1, 3)
        until(lambda: recorder.written == 11)
        path.rename(away)
        Due.now = True
        until(lambda: later_pieces(path))
        Due.now = False
        steps(recorder, 4, 5)
    assert not recorder.failure and recorder.lost == 0
    for file, expected in ((away, [1, 2, 3]), (path, [4, 5])):
        with Log(file) as log:
            assert log.complete and [frame.step for frame in log.frames("beam")] == expected


def test_files_of_an_earlier_log_are_replaced_and_others_are_not(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, rotation=Rotation(bytes=1e6)) as recorder:
        begin(recorder)
        steps(recorder, 1, 200)
    assert later_pieces(path)
    (tmp_path / "run.0099.mcap").write_text("precious")
    with Recorder(path, overwrite=True) as recorder:
        begin(recorder)
    assert [piece.name for _, piece in later_pieces(path)] == ["run.0099.mcap"]
    with Log(path) as log:
        assert log.complete, "a file of another run is none of this log"
    assert (tmp_path / "run.0099.mcap").read_text() == "precious"


def test_a_removed_file_is_told_and_a_new_one_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, told = tmp_path / "run.mcap", []
    with Recorder(path, report=told.append) as recorder:
        may_go_on, room = Pieces.may_go_on, threading.Event()
        monkeypatch.setattr(Pieces, "may_go_on", lambda pieces, first: room.is_set() and may_go_on(pieces, first))
        begin(recorder)
        steps(recorder, 1, 5)
        until(lambda: recorder.written == 17)
        path.unlink()
        until(lambda: recorder.broken)  # though nothing is written
        assert "the file was removed" in recorder.failure
        steps(recorder, 6, 6)  # lost
        room.set()
        until(lambda: not recorder.broken)
        steps(recorder, 7, 12)
    assert len(told) == 2 and "it goes on in" in told[1] and "3 records are missing" in told[1]
    assert recorder.failure and recorder.lost == 2 and recorder.dropped == 1
    with Log(path) as log:
        assert [frame.step for frame in log.frames("beam")] == list(range(7, 13))
        assert len(log.mesh("beam", log.objects["beam"].epochs[0]).tets) == len(TETS)


FULL = """
import sys, time
from pathlib import Path
from tests.log.test_log_pieces import begin, on_disk, steps, until
from sim_server.recording.recorder import Recorder
folder = Path(sys.argv[1])
ballast = folder / "ballast"
with Recorder(folder / "run.mcap") as recorder:
    begin(recorder)
    steps(recorder, 1, 50)
    until(lambda: on_disk(folder / "run.mcap") == 152)
    with open(ballast, "wb") as file:
        try:
            while True:
                file.write(bytes(1 << 16)); file.flush()
        except OSError:
            pass
    k = 50
    began = time.monotonic()
    while not recorder.broken:
        k += 1
        steps(recorder, k, k)
        time.sleep(0.005)
    assert "No space left on device" in recorder.failure, recorder.failure
    steps(recorder, k + 1, k + 5)
    ballast.unlink()
    until(lambda: not recorder.broken)
    steps(recorder, k + 6, k + 20)
print(k, recorder.lost, recorder.dropped)
"""


def test_a_full_disk_that_is_freed(tmp_path: Path) -> None:
    """On a file system of 12 MB, in a mount namespace of its own."""
    script = f'mount -t tmpfs -o size=12m none {tmp_path} && exec {sys.executable} -c "$CODE" {tmp_path}; '
    copy = f"cp {tmp_path}/*.mcap $KEEP"
    keep = tmp_path.parent / "kept"
    keep.mkdir()
    command = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", f"({script}) && {copy}"]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "CODE": FULL, "KEEP": str(keep), "PYTHONPATH": str(root)}
    probe = subprocess.run([*command[:4], "true"], capture_output=True)
    if probe.returncode:
        pytest.skip("no mount namespace of its own is to be had here")
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root, timeout=100)
    assert done.returncode == 0, done.stderr
    last, lost, dropped = map(int, done.stdout.split())
    with Log(keep / "run.mcap") as log:
        seen = [frame.step for frame in log.frames("beam")]
        assert seen == sorted(set(seen)) and seen[-15:] == list(range(last + 6, last + 21))
        assert set(range(1, 51)) <= set(seen), "all from before the disk was full"
        assert not log.complete
    assert dropped >= 5 and lost >= 10


def test_a_limit_of_file_size_is_no_end(tmp_path: Path) -> None:
    """RLIMIT_FSIZE, as `ulimit -f` sets: the log goes on in a new file."""
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from tests.log.test_log_pieces import begin, steps, until\n"
        "from sim_server.recording.recorder import Recorder\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, resource.RLIM_INFINITY))\n"
        "with Recorder(Path(sys.argv[1])) as recorder:\n"
        "    begin(recorder)\n"
        "    k = 0\n"
        "    while not recorder.broken:\n"
        "        k += 1; steps(recorder, k, k)\n"
        "    assert 'File too large' in recorder.failure, recorder.failure\n"
        "    until(lambda: not recorder.broken)\n"
        "    steps(recorder, 1000, 1010)\n"
    )
    path, root = tmp_path / "run.mcap", Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], cwd=root, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[1] == resource.RLIM_INFINITY
    with Log(path) as log:
        assert [frame.step for frame in log.frames("beam")][-11:] == list(range(1000, 1011))


@pytest.mark.parametrize(
    ("rotate", "keep", "said"),
    [
        (["much"], None, "--record-rotate much: allowed is a size of at least 1MB"),
        (["10"], None, "--record-rotate 10: allowed"),
        (["1KB"], None, "--record-rotate 1KB"),
        (["0.5s"], None, "a time of at least 1s"),
        (["1MB"], "1h", "--record-keep 1h: allowed is a size of at least 2MB"),
        ([], "1GB", "--record-keep goes with --record-rotate"),
    ],
)
def test_bad_values_are_named(rotate: list[str], keep: str | None, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Rotation.of_options(rotate, keep)


def test_sizes_and_times() -> None:
    assert Rotation.of_options(["500MB", "2GiB", "90min", "1h"], "600MB") == Rotation(300e6, 3600, 600e6)
    assert Rotation.of_options([], None) == Rotation()
