# SPDX-License-Identifier: MIT
"""Server and worker under systemd: what they say to the notify socket, and the units that come along."""

import configparser
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from link_helpers import ROOT
from server_process import Stage, beam, fresh

from protocol.process.notify import Notifier
from sim_server.service.health import Health
from tests.ports import free_endpoint

pytestmark = pytest.mark.system
UNITS = ROOT / "deploy" / "systemd"
SERVICES = ("warpfactor-server@.service", "warpfactor-worker@.service")


class Manager:
    """Plays the socket of a service manager."""

    def __init__(self, path: str):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(path)
        self.socket.settimeout(60)

    def next(self) -> dict[str, str]:
        return dict(line.split("=", 1) for line in self.socket.recv(4096).decode().splitlines())


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(str(tmp_path / "notify"))
    yield manager
    manager.socket.close()


def test_a_server_is_ready_goes_on_and_stops(manager: Manager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "400000")
    stage = Stage(tmp_path)
    try:
        server = stage.server(beam(tmp_path), "--device", "cpu")
        first = manager.next()
        assert first["READY"] == "1" and "beam.toml" in first["STATUS"]
        with stage.client() as client:
            assert all(manager.next() == {"WATCHDOG": "1"} for _ in range(3))
            client.pause()
            assert fresh(client).state == "paused"
            manager.socket.setblocking(False)
            with pytest.raises(BlockingIOError):
                while True:  # what came before the pause
                    manager.next()
            manager.socket.settimeout(60)
            assert manager.next() == {"WATCHDOG": "1"}, "a pause is no hang"
        server.end()
        while (last := manager.next()) == {"WATCHDOG": "1"}:
            pass
        assert last == {"STOPPING": "1"}
    finally:
        stage.close()


def test_a_worker_is_ready_before_there_is_a_server(manager: Manager, tmp_path: Path) -> None:
    environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "2000000"}
    command = [sys.executable, "-m", "precond_worker", "--connect", free_endpoint()]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL) as worker:
        try:
            assert manager.next()["READY"] == "1"
            assert manager.next() == manager.next() == {"WATCHDOG": "1"}
        finally:
            worker.terminate()
    assert worker.returncode == 0


def test_a_loop_that_hangs_feeds_no_watchdog(manager: Manager, tmp_path: Path) -> None:
    now = [0.0]
    notifier = Notifier(str(tmp_path / "notify"), 4.0, lambda: now[0])
    health = Health(notifier, lambda: now[0])
    manager.socket.settimeout(0.2)
    health.look(1, False)
    assert manager.next() == {"WATCHDOG": "1"}
    for k in range(20):
        now[0] += 1.0
        health.look(1, False)
        assert health.why_not() == "", k
    with pytest.raises(TimeoutError):
        manager.next()
    health.look(2, False)
    assert manager.next() == {"WATCHDOG": "1"}
    now[0] += 0.5
    health.look(3, False)
    with pytest.raises(TimeoutError):
        manager.next()  # not more often than is of use


def test_an_abstract_socket_and_none() -> None:
    name = f"@warpfactor-{os.getpid()}-{time.monotonic_ns()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.bind("\0" + name[1:])
        Notifier(name).ready("up")
        assert there.recv(100) == b"READY=1\nSTATUS=up"
    Notifier(name).ready("nobody hears it")
    Notifier().ready("nor this")


def test_children_do_not_speak_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
    monkeypatch.setenv("WATCHDOG_USEC", "5000000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert Notifier.of_environment().watchdog == 0, "that of another process"
    assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"} & os.environ.keys()


@pytest.mark.parametrize("name", SERVICES)
def test_units_start_what_there_is_and_let_it_lock_its_memory(name: str) -> None:
    from protocol.shared_memory.limits import POOL_LIMIT
    from tests.docs.test_commands import PROGRAMS

    unit = configparser.RawConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(UNITS / name)
    service = unit["Service"]
    program, *words = service["ExecStart"].split()
    command = {"sim-server": "sim-server SCENE.toml", "precond-worker": "precond-worker"}[Path(program).name]
    known = {option for p in PROGRAMS[command].params for option in p.opts}
    assert {word for word in words if word.startswith("--")} <= known
    assert (service["Type"], service["NotifyAccess"]) == ("notify", "main") and int(service["WatchdogSec"]) >= 60
    assert int(service["LimitMEMLOCK"].removesuffix("K")) * 1024 >= POOL_LIMIT + (64 << 20)
    assert int(service["RestartPreventExitStatus"]) == 2
    for hardening in ("NoNewPrivileges", "ProtectHome", "PrivateTmp", "RestrictNamespaces"):
        assert service[hardening] == "yes"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong_with_the_units(tmp_path: Path) -> None:
    for name in SERVICES:
        text = (UNITS / name).read_text()
        start = next(line for line in text.splitlines() if line.startswith("ExecStart="))
        (tmp_path / name).write_text(text.replace(start.split()[0], "ExecStart=/bin/true"))  # it is not installed here
    files = [str(tmp_path / name) for name in SERVICES]
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", *files], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr


def test_a_dead_server_is_not_ready(tmp_path: Path) -> None:
    """Bad input ends before READY: systemd does not start it again."""
    with Manager(str(tmp_path / "notify")).socket as there:
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")}
        command = [sys.executable, "-m", "sim_server", str(tmp_path / "none.toml")]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=60)
        assert done.returncode == 2
        there.setblocking(False)
        with pytest.raises(BlockingIOError):
            there.recv(100)
