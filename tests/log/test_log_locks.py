# SPDX-License-Identifier: MIT
"""Two who record to one file: the second is refused, and the log of the first stays whole."""

import os
import time
from pathlib import Path
from typing import Any

import pytest

from clients.log.reader import Log
from protocol import messages_pb2 as pb
from protocol.log_pieces import later_pieces
from sim_server.errors import InputError
from sim_server.recording import file_lock, pieces
from sim_server.recording.recorder import Recorder
from sim_server.recording.rotation import Kept, Rotation

RUN = pb.Scene(name="s.toml", resolved="{}", dt=0.1, objects=["beam"])


def recorder(path: Path, **options: Rotation) -> Recorder:
    found = Recorder(path, overwrite=True, **options)
    found.scene(RUN)
    return found


def test_a_second_log_of_a_name_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    told = r"run\.mcap: another server records to this file now; choose another name"
    with recorder(path), pytest.raises(InputError, match=told):
        Recorder(path, overwrite=True)
    with Log(path) as log:
        assert log.complete and log.scene is not None
    with recorder(path):
        pass


@pytest.mark.parametrize("first_is_there", [True, False])
def test_a_log_in_pieces_is_locked_as_a_whole(tmp_path: Path, first_is_there: bool) -> None:
    """Also while a later file is written, and when a budget has removed the first one."""
    path = tmp_path / "run.mcap"
    with recorder(path, rotation=Rotation(bytes=1e6)) as first:
        for k in range(12):  # 3 MB that nothing compresses
            first.interaction(pb.Interaction(object="beam", held=os.urandom(1 << 18)), 0.1 * k, block=True)
        end = time.monotonic() + 60
        while not later_pieces(path) and time.monotonic() < end:
            time.sleep(0.01)
        if not first_is_there:
            path.unlink()
        with pytest.raises(InputError, match="another server records to this file now"):
            Recorder(path, overwrite=True)
        assert later_pieces(path)
    with recorder(path):
        pass


def test_a_log_stays_locked_while_its_next_file_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, locked = tmp_path / "run.mcap", []

    class Begun(pieces.McapFile):
        def __init__(self, new: Path, *options: Any) -> None:
            locked.append([file_lock.is_locked(piece) for _, piece in later_pieces(path)])
            super().__init__(new, *options)

    monkeypatch.setattr(pieces, "McapFile", Begun)
    with recorder(path, rotation=Rotation(bytes=1e6)) as written:
        for k in range(32):
            written.interaction(pb.Interaction(object="beam", held=os.urandom(1 << 18)), 0.1 * k, block=True)
    assert len(locked) > 3 and all(newest for *_, newest in locked[2:])


def test_a_budget_removes_no_log_that_somebody_writes(tmp_path: Path) -> None:
    ended, written = tmp_path / "run-1.mcap", tmp_path / "run-2.mcap"
    recorder(ended).close()
    with recorder(written):
        kept = Kept(Rotation(keep=1.0, earlier=(ended, written)))
        kept.keep_budget(0)
        assert written.exists() and not ended.exists() and kept.removed == 1


def test_a_file_system_without_locks_records_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(file_lock.errno.ENOLCK, "No locks available")

    monkeypatch.setattr(file_lock.fcntl, "flock", refuse)
    path = tmp_path / "run.mcap"
    with recorder(path), recorder(path):  # nothing tells them apart
        assert not file_lock.is_locked(path)


def test_what_is_no_file_is_not_locked() -> None:
    with Recorder("/dev/null", overwrite=True), Recorder("/dev/null", overwrite=True):
        pass
