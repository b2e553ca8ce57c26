# SPDX-License-Identifier: MIT
"""What killed processes leave in folders of the cache is removed by those who write there; nothing else is."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol.process import cache_folder as module
from protocol.process.cache_folder import STALE, remove_stale, unfinished
from protocol.process.kept_files import keep, read_kept
from sim_server.backends.build_pool import Job

KILLED = """
import os, signal, sys
from pathlib import Path
from protocol.process import kept_files
os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
kept_files.keep(Path(sys.argv[1]), b"half of it", 1 << 20)
"""


@pytest.fixture(autouse=True)
def _fresh():
    remove_stale.cache_clear()


def aged(path: Path, seconds: float = STALE + 60) -> Path:
    then = time.time() - seconds
    os.utime(path, (then, then), follow_symlinks=False)
    return path


def test_what_a_killed_process_left_goes_when_it_is_a_day_old(tmp_path):
    path = tmp_path / "a.order"
    ended = subprocess.run([sys.executable, "-c", KILLED, str(path)])
    assert ended.returncode == -9
    (left,) = tmp_path.iterdir()
    keep(tmp_path / "b.order", b"young", 1 << 20)
    assert left.exists()  # its process may be at work
    aged(left)
    remove_stale.cache_clear()
    keep(path, b"whole", 1 << 20)
    assert not left.exists() and read_kept(path, 100) == b"whole"
    assert {p.name for p in tmp_path.iterdir()} == {"a.order", "b.order"}


def test_only_unfinished_files_of_this_user_go(tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.write_bytes(b"")
    link = tmp_path / "link.12.tmp"
    link.symlink_to(other)
    folder = tmp_path / "folder.12.tmp"
    folder.mkdir()
    kept = [tmp_path / name for name in ("loop-1f2e.so", "liver.npz", "tmp", "tmpabc", "notes.tmp")]
    for path in kept:
        path.write_bytes(b"")
    for path in [link, folder, *kept]:
        aged(path)
    gone = [tmp_path / name for name in ("loop-1f2e.4711.tmp", "tmpab_9xyz0", "a.b1c2.7.tmp")]
    for path in gone:
        path.write_bytes(b"")
        aged(path)
    monkeypatch.setattr(module.os, "geteuid", lambda: os.getuid() + 1)
    remove_stale(tmp_path)
    assert all(path.exists() for path in gone)  # somebody else's
    monkeypatch.undo()
    remove_stale.cache_clear()
    remove_stale(tmp_path)
    assert not any(path.exists() for path in gone)
    assert all(path.exists() for path in [link, folder, other, *kept])


def test_a_folder_that_is_not_there_is_no_matter(tmp_path):
    remove_stale(tmp_path / "none")


def test_compilers_name_theirs_alike(tmp_path):
    """As what is removed is named."""
    scratch = Job("loop.cpp", tmp_path / "loop-1f2e.so", []).scratch
    assert scratch == unfinished(tmp_path / "loop-1f2e.so") and module.NAME.fullmatch(scratch.name)
