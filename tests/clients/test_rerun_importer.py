# SPDX-License-Identifier: MIT
"""rerun opens logs by an executable of ours on PATH; what it got is read back by rerun's own reader."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from tests.clients.test_view import Rrd
from tests.sample_run import DT, positions, record

ROOT = Path(__file__).parents[2]
STEPS = 4
NAME = "rerun-importer-warpfactor"


@pytest.fixture(scope="module")
def importer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The executable as pip makes it from the entry point."""
    module, function = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"][NAME].split(":")
    path = tmp_path_factory.mktemp("bin") / NAME
    path.write_text(f"#!{sys.executable}\nimport sys\nfrom {module} import {function}\nsys.exit({function}())\n")
    path.chmod(0o755)
    return path


def environment(importer: Path) -> dict[str, str]:
    return os.environ | {"PATH": f"{importer.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}


def asked(importer: Path, *words: object) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([importer, *map(str, words)], capture_output=True, env=environment(importer), timeout=60)


def check(path: Path) -> None:
    """A recording has the nodes of every frame at its time."""
    found = Rrd(path).column("/world/beam", "vertex_positions")
    assert [(step, time) for step, time, _ in found] == [(k, pytest.approx(k * DT, abs=1e-9)) for k in range(STEPS + 1)]
    for step, _, values in found:
        np.testing.assert_array_equal(values, positions(step).astype(np.float32))


def test_the_recording_on_stdout_has_every_frame(importer: Path, tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    log = record(tmp_path / "run.mcap", STEPS)
    found = asked(importer, log, "--application-id", "app", "--recording-id", "rec_1", "--time_sequence", "step=3")
    assert found.returncode == 0, found.stderr
    (tmp_path / "run.rrd").write_bytes(found.stdout)
    check(tmp_path / "run.rrd")
    entities = {str(c.entity_path) for c in chunk.RrdReader(tmp_path / "run.rrd").stream()}
    assert not [e for e in entities if e.startswith(("/scene", "/state", "/step", "/topology"))], (
        "those are rerun's own"
    )
    (recording,) = chunk.RrdReader(tmp_path / "run.rrd").recordings()
    assert (recording.application_id, recording.recording_id) == ("app", "rec_1")


def test_other_files_are_left_to_others(importer: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="somebody")
        channel = writer.register_channel("/chatter", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    (tmp_path / "text.mcap").write_text("no log")
    (tmp_path / "empty").write_bytes(b"")
    for name in ("foreign.mcap", "text.mcap", "empty", "missing.mcap", "."):
        found = asked(importer, tmp_path / name)
        assert (found.returncode, found.stdout, found.stderr) == (66, b"", b""), name


@pytest.mark.system
def test_rerun_itself_asks_for_files_of_unknown_suffix(importer: Path, tmp_path: Path) -> None:
    """And for .mcap it does not, so that those are piped."""
    pytest.importorskip("rerun")
    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip("no rerun executable beside Python")
    log = record(tmp_path / "run.warpfactor", STEPS)
    command = [rerun, log, "--save", tmp_path / "out.rrd", "--port", "0"]
    found = subprocess.run(command, capture_output=True, env=environment(importer), timeout=100)
    assert found.returncode == 0, found.stderr
    check(tmp_path / "out.rrd")
