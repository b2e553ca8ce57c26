# SPDX-License-Identifier: MIT
"""sim-client as a user runs it: output, messages, exit codes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.clients.fake_server import FakeServer
from tests.ports import free_port
from tests.sample_run import record
from tests.support.commands import Ended, in_turn

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer() as started:
        yield started


def start(*arguments: str | Path, **variables: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "clients", *map(str, arguments)]
    environment = os.environ | {"COLUMNS": "160"} | variables
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def run(*arguments: str | Path, **variables: str) -> tuple[int, str, str]:
    """Exit code, stdout, stderr; never a traceback. variables: of the environment."""
    process = start(*arguments, **variables)
    out, err = process.communicate(timeout=100)
    assert "Traceback" not in err, err
    return process.returncode, out, err


def test_status(server: FakeServer) -> None:
    code, out, _ = run("status", "--connect", server.endpoint)
    assert code == 0
    assert "made-up.toml" in out and "running, step 50" in out and "p99 6.00 ms" in out
    assert "liver" in out and "block_jacobi" not in out and "supernodal" in out


def test_status_as_json(server: FakeServer) -> None:
    code, out, _ = run("status", "--json", "--connect", server.endpoint)
    found = json.loads(out)
    assert code == 0 and found["step"] == 50 and found["step_p99"] == 0.006
    assert found["objects"][0]["last"]["status"] == "converged" and found["objects"][0]["last"]["factor_step"] == 48
    assert found["workers"][0]["jobs"] == 3 and found["refused"] == 0


@pytest.mark.parametrize(("package", "name"), [
    ("clients", "sim-client"), ("sim_server", "sim-server"), ("precond_worker", "precond-worker")
])  # fmt: skip
def test_version(package: str, name: str) -> None:
    result = subprocess.run([sys.executable, "-m", package, "--version"], capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0 and result.stderr == ""
    assert result.stdout.startswith(f"{name} ") and len(result.stdout.split()) >= 2


def test_watch_a_few_times(server: FakeServer) -> None:
    code, out, _ = run("watch", "--count", "2", "--connect", server.endpoint)
    assert code == 0 and "beam" in out


def test_push(server: FakeServer) -> None:
    code, out, err = run(
        "push", "--object", "beam", "--at", "-1", "0", "0", "--force", "0", "-50", "0", "--connect", server.endpoint
    )
    assert (code, err) == (0, "") and "pushed 4 nodes of beam at (-1, 0, 0) for 0.1 s" in out
    assert server.commands[-1].interaction.point.x == -1 and server.commands[-1].interaction.force.y == -50


@pytest.mark.parametrize(
    ("at", "point"),
    [
        ((), "tip"),
        (("--at", "top"), "top"),
        (("--at", "-1", ".5", "2e0"), (-1, 0.5, 2)),
        (("--at=-1,.5,2",), (-1, 0.5, 2)),
    ],
)
def test_where_to_push(server: FakeServer, at: tuple[str, ...], point: str | tuple[float, float, float]) -> None:
    command = ("push", "--object", "beam", *at, "--force", "0", "-50", "0")
    code, out, err = run(*command, WARPFACTOR_CONNECT=server.endpoint)
    assert (code, err) == (0, "")
    sent = server.commands[-1].interaction
    assert sent.force.y == -50
    if isinstance(point, str):
        assert sent.at == point and not sent.HasField("point") and "4 nodes of beam at (1, 2, 3)" in out
    else:
        assert sent.at == "" and (sent.point.x, sent.point.y, sent.point.z) == point


def test_the_server_of_the_environment(server: FakeServer) -> None:
    both = f"tcp/127.0.0.1:9, {server.endpoint}"
    assert run("status", "--json", WARPFACTOR_CONNECT=both)[0] == 0
    code, _, err = run("status", "--connect", "tcp/127.0.0.1:9", WARPFACTOR_CONNECT=server.endpoint)
    assert code == 1 and "no server 'sim' at tcp/127.0.0.1:9" in err, "the option comes first"
    code, _, err = run("status", WARPFACTOR_CONNECT="nonsense")
    assert code == 2 and "WARPFACTOR_CONNECT: endpoint 'nonsense' cannot be used" in err


@pytest.mark.parametrize(
    ("package", "words", "found"),
    [
        ("clients", "sim-client pu", {"push"}),
        ("clients", "sim-client push --ra", {"--radius"}),
        ("sim_server", "sim-server --wor", {"--workers", "--worker-device"}),
        ("precond_worker", "precond-worker --prec", {"--precision"}),
    ],
)
def test_completion(package: str, words: str, found: set[str]) -> None:
    """What the script asks that --install-completion puts into bash."""
    variable = f"_{words.split()[0].upper().replace('-', '_')}_COMPLETE"
    asked = {variable: "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    result = subprocess.run(
        [sys.executable, "-m", package], capture_output=True, text=True, cwd=ROOT, env=os.environ | asked
    )
    assert set(result.stdout.split()) == found and result.stderr == ""


def test_grab_moves_on_a_line(server: FakeServer) -> None:
    code, out, _ = run(
        *("grab", "--object", "beam", "--at", "1", "0", "0", "--to", "1", "2", "4"),
        *("--duration", "0.3", "--connect", server.endpoint),
    )
    assert code == 0 and "released" in out
    verbs = [command.verb for command in server.commands]
    assert verbs[0] == "grab" and verbs[-1] == "release" and set(verbs[1:-1]) == {"move"}
    targets = [command.interaction.target for command in server.commands[1:-1]]
    assert all(target.x == 1 and target.z == pytest.approx(2 * target.y) for target in targets)
    assert [t.y for t in targets] == sorted(t.y for t in targets) and targets[-1].y == 2


@pytest.mark.parametrize(
    "command",
    [("grab", "--at", "1", "0", "0", "--to", "1", "2", "4"), ("push", "--force", "1", "0", "0")],
    ids=["grab", "push"],
)
def test_ctrl_c_releases_and_says_130(server: FakeServer, command: tuple[str, ...]) -> None:
    process = start(*command, "--object", "beam", "--duration", "60", "--connect", server.endpoint)
    deadline = time.monotonic() + 30
    while len(server.commands) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in err
    assert server.commands[-1].verb == "release"


def test_pause_resume_stop(server: FakeServer) -> None:
    said = ("paused at step 50", "goes on from step 50", "stopped after 50 steps")
    for verb, expected in zip(("pause", "resume", "stop"), said, strict=True):
        assert run(verb, "--connect", server.endpoint)[:2] == (0, f"{expected} (t = 1.000 s)\n")
    assert [command.verb for command in server.commands] == ["pause", "resume", "stop"]


def test_a_stop_that_waits_for_a_very_long_step_does_not_tell_it_as_the_last(server: FakeServer) -> None:
    server.stopped = "running"
    said = "stops after the step under way, with 50 steps (t = 1.000 s)\n"
    assert run("stop", "--connect", server.endpoint)[:2] == (0, said)


def test_refused_command_is_bad_input(server: FakeServer) -> None:
    code, _, err = run(
        "push", "--object", "spleen", "--at", "0", "0", "0", "--force", "1", "0", "0", "--connect", server.endpoint
    )
    assert code == 2 and err == "sim-client: push: no object 'spleen'; there is beam, liver\n"


ERRORS: list[tuple[tuple[str, ...], int, str]] = [
    ((), 2, "Usage"),
    (("fly",), 2, "No such command 'fly'"),
    (("push",), 2, "Missing option '--object'"),
    (("push", "--object", "b", "--at", "1", "2", "x", "--force", "0", "0", "0"), 2, "--at"),
    (("status", "--connect", "nowhere"), 2, "endpoint 'nowhere' cannot be used"),
    (("push", "--object", "b", "--at", "1", "2", "--force", "0", "0", "0"), 2, "--at 1 2: allowed are three"),
    (("status", "--connect", "tcp/no-such-host.invalid:1"), 1, "the name 'no-such-host.invalid' does not resolve"),
    (("status", "--connect", "tcp/127.0.0.1:9"), 1, "no server 'sim' at tcp/127.0.0.1:9; is it running?"),
    (("worker", "kill"), 2, "worker: give the NAME of a worker to kill"),
    (("view",), 2, "give either a log or --live"),
    (("view", "x.mcap", "--live"), 2, "give either a log or --live"),
    (("view", "--live", "--save", "x.rrd"), 2, "need a log"),
    (("view", "gone.mcap"), 2, "gone.mcap: cannot be read: No such file or directory"),
    (("export", "gone.mcap", "--object", "beam", "--to", "x.npz"), 2, "gone.mcap: cannot be read"),
    (("export", "pyproject.toml", "--object", "beam", "--to", "x.npz"), 2, "not an MCAP file"),
]
COMMANDS = (
    "status",
    "watch",
    "push",
    "grab",
    "haptics",
    "move-obstacle",
    "pause",
    "resume",
    "stop",
    "worker",
    "view",
    "export",
    "foxglove",
)


@pytest.fixture(scope="module")
def ended() -> dict[tuple[str, ...], Ended]:
    """What comes of commands that need no server, one after another in one process."""
    return in_turn("clients", [*(arguments for arguments, _, _ in ERRORS), *((name, "--help") for name in COMMANDS)])


@pytest.mark.parametrize(("arguments", "code", "said"), ERRORS)
def test_errors(ended: dict[tuple[str, ...], Ended], arguments: tuple[str, ...], code: int, said: str) -> None:
    found, out, err = ended[arguments]
    assert found == code and said in out + err and "Traceback" not in err


def test_an_error_ends_the_process(tmp_path: Path) -> None:
    assert run("view", tmp_path / "gone.mcap")[0] == 2
    assert run("push")[0] == 2


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples(ended: dict[tuple[str, ...], Ended], command: str) -> None:
    code, out, _ = ended[command, "--help"]
    assert code == 0 and f"Examples:\n    sim-client {command}" in out


def test_export(tmp_path: Path) -> None:
    log = record(tmp_path / "run.mcap", 5)
    code, out, err = run("export", log, "--object", "beam", "--to", tmp_path / "beam.npz")
    assert (code, err) == (0, "") and out == f"wrote {tmp_path / 'beam.npz'}\n"
    with np.load(tmp_path / "beam.npz") as found:
        assert found["x"].shape == (6, 5, 3)
    code, out, _ = run("export", log, "--object", "beam", "--to", tmp_path / "beam.vtu", "--frame", "all")
    assert code == 0 and out == f"wrote {tmp_path / 'beam.pvd'} and 6 more\n"


def test_export_of_all_objects(tmp_path: Path) -> None:
    log = record(tmp_path / "run.mcap", 5, ("beam", "liver"))
    code, out, err = run("export", log, "--to", tmp_path / "run.csv")
    assert (code, err) == (0, "") and out == f"wrote {tmp_path / 'run_liver.csv'} and 1 more\n"
    code, out, err = run("export", log, "--to", tmp_path / "run.foxglove.mcap")
    assert (code, err) == (0, "") and out == f"wrote {tmp_path / 'run.foxglove.mcap'} and 1 more\n"
    code, out, err = run("export", log, "--to", tmp_path / "run.obj")
    assert (code, out) == (2, "") and ".vtu, .vtkhdf, .usdc, .mp4, .mcap" in err


def test_the_bridge_to_foxglove_ends_by_ctrl_c(server: FakeServer, tmp_path: Path) -> None:
    port, layout = str(free_port()), tmp_path / "layout.json"
    process = start("foxglove", "--port", port, "--layout", layout, "--connect", server.endpoint)
    assert process.stdout is not None
    assert process.stdout.readline() == f"sim-client: open ws://127.0.0.1:{port} in Foxglove or Lichtblick\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
    assert "/step/liver.kinetic_energy" in layout.read_text()


def test_export_of_a_cut_log_says_so(tmp_path: Path) -> None:
    log = record(tmp_path / "run.mcap", 5)
    whole = log.read_bytes()
    log.write_bytes(whole[: whole.index(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")])  # without the end mark
    code, out, err = run("export", log, "--object", "beam", "--to", tmp_path / "beam.csv")
    assert code == 0 and "wrote" in out
    assert "without an end mark: the server was killed, or is still recording" in err


def test_view_saves(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    log = record(tmp_path / "run.mcap", 5)
    assert run("view", log, "--save", tmp_path / "run.rrd", "--color", "von_mises")[0] == 0
    assert (tmp_path / "run.rrd").stat().st_size > 1000
