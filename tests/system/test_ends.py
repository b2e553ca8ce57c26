# SPDX-License-Identifier: MIT
"""How programs end that are interrupted early, or run out of memory or disk: exit code and one line, no traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clients.log.reader import Log
from sim_server.recording.starts import earlier, started
from tests.ports import free_endpoint
from tests.sample_run import record
from tests.system.link_helpers import PATIENCE, ROOT
from tests.system.server_process import Stage, beam, fresh, run, until

pytestmark = pytest.mark.system
FOLDER = Path(__file__).parent


def ended(script: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """A program run by one of the scripts beside this file."""
    command = [sys.executable, str(FOLDER / script), *arguments]
    paths = {**os.environ, "PYTHONPATH": str(ROOT), "RUST_BACKTRACE": "0"}
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE, env=paths)


NOWHERE = ("--connect", "tcp/127.0.0.1:9")
EARLY = {
    "server, typer": ("typer", "sim_server", 0),
    "server, numpy": ("numpy", "sim_server", 0),
    "server, an effect": ("sim_server.effects.gravity", "sim_server", 0),
    "worker, typer": ("typer", "precond_worker", 0),
    "worker, zenoh": ("zenoh", "precond_worker", 0),
    "client, typer": ("typer", "clients", 143),
    "client, the library": ("clients.grab", "clients", 143),
}


@pytest.mark.parametrize(("module", "package", "code"), EARLY.values(), ids=EARLY.keys())
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_a_signal_in_the_middle_of_an_import(module: str, package: str, code: int, number: str, tmp_path: Path) -> None:
    """Ctrl-C: 130; SIGTERM: as later in the run."""
    arguments = {
        "sim_server": (str(beam(tmp_path, bar=(1, 1, 2))), "--listen", free_endpoint(), "--device", "cpu"),
        "precond_worker": NOWHERE,
        "clients": ("status", *NOWHERE),
    }[package]
    done = ended("interrupt_at.py", number, module, package, *arguments)
    assert done.returncode == (130 if number == "SIGINT" else code), done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


def test_too_little_memory_is_one_line(tmp_path: Path) -> None:
    scene = beam(tmp_path, bar=(1, 1, 2))
    arguments = ("sim_server", str(scene), "--listen", free_endpoint(), "--device", "cpu", "--steps", "5")
    done = ended("short_of.py", "RLIMIT_AS", str(256 << 20), *arguments)
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    said = [line for line in done.stderr.splitlines() if line.startswith("sim-server: ")]
    assert len(said) == 1 and ("no more threads" in said[0] or "out of memory" in said[0] or "cannot go on" in said[0])


@pytest.mark.parametrize("pace", ["--realtime", "--free-run"])
def test_a_full_disk_is_told_and_the_exit_code_is_1(pace: str, tmp_path: Path) -> None:
    """Files of 10 kB at most stand for it; the run itself goes on to its end."""
    scene, log = beam(tmp_path), tmp_path / "run.mcap"
    arguments = (str(scene), "--listen", free_endpoint(), "--device", "cpu", "--steps", "60", pace)
    done = ended("short_of.py", "RLIMIT_FSIZE", "10000", "sim_server", *arguments, "--record", str(log))
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert "shared memory is off, arrays travel as bytes" in done.stderr and "files may have 9 KiB" in done.stderr
    assert done.stderr.count("recording stopped after") == 1 and "File too large" in done.stderr
    assert f"exit code 1: the log {log} is not whole" in done.stderr
    assert "60 steps" in done.stdout


def test_a_log_that_is_removed_is_told(tmp_path: Path) -> None:
    """In the status, on stderr, in the exit code."""
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    try:
        server = stage.server(beam(tmp_path), "--device", "cpu", "--record", str(log))
        with stage.client() as client:
            until(lambda: client.status().step > 5, "the simulation runs")
            assert fresh(client).recording_failure == ""
            log.unlink()
            until(lambda: fresh(client).recording_failure, "the failure is in the status")
            assert "the file was removed or replaced" in client.status().recording_failure
            step = client.status().step
            until(lambda: fresh(client).step > step, "the run goes on")
            client.command("stop")
        assert server.wait() == 1
        assert server.output().count("the file was removed or replaced") == 1
        assert "exit code 1" in server.output() and not log.exists()
    finally:
        stage.close()


def test_a_picture_file_on_a_full_disk_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    log = record(tmp_path / "run.mcap", 3)
    with Log(log) as opened:
        assert opened.complete
    for limit in ("1000", "30000"):
        picture = ("view", str(log), "--save", str(tmp_path / "x.rrd"))
        done = ended("short_of.py", "RLIMIT_FSIZE", limit, "clients", *picture)
        assert done.returncode == 1
        assert done.stderr == f"sim-client: {tmp_path / 'x.rrd'}: cannot be written: File too large\n"
        assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap"]


def test_a_server_that_is_started_again_keeps_its_log(tmp_path: Path) -> None:
    template = tmp_path / "run-{time}.mcap"
    options = ["--free-run", "--steps", "2", "--record-rotate", "1MB", "--record-keep", "10MB"]
    for starts in (1, 2):
        server = run(
            "sim_server",
            str(beam(tmp_path, (1, 1, 2))),
            "--listen",
            free_endpoint(),
            "--record",
            str(template),
            *options,
        )
        assert server.returncode == 0, server.stderr
        logs = earlier(template)
        assert len(logs) == starts and not template.exists()
        with Log(logs[-1]) as log:
            assert log.complete
        logs[-1].rename(started(template, 60 * starts))  # two starts within a second would be one
