# SPDX-License-Identifier: MIT
"""A real sim-server, real workers and a client, as separate processes on a port of their own."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from clients.client import Client
from clients.errors import ClientError
from protocol import messages_pb2 as pb
from tests.ports import free_endpoint
from tests.system.link_helpers import PATIENCE, ROOT

BEAM = """
dt = 0.02
[effects]
gravity = {{ g = [0, -9.81, 0] }}
[solver]
preconditioner = "cholesky"
{solver}
[[object]]
name = "beam"
mesh = {{ bar = {bar}, size = [1, 1, 4], split = "kuhn" }}
[object.effects]
corotational = {{ young = 1e6, poisson = 0.4 }}
rayleigh = {{ mass = 0.1 }}
fixed = {{ where = "Z < 0.01" }}
touch = true
"""


def beam(folder: Path, bar: tuple[int, int, int] = (3, 3, 10), solver: str = "") -> Path:
    """A scene file with one beam."""
    path = folder / "beam.toml"
    path.write_text(BEAM.format(bar=list(bar), solver=solver))
    return path


def tool(package: str, *arguments: str) -> list[str]:
    """Command line of one of our programs."""
    return [sys.executable, "-m", package, *arguments]


def run(
    package: str, *arguments: str, timeout: float = PATIENCE, **environment: str
) -> "subprocess.CompletedProcess[str]":
    """One of our programs, to its end; environment: beside that of this process."""
    command, variables = tool(package, *arguments), {**os.environ, **environment}
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=timeout, env=variables)


class Process:
    """One of our programs in the background; its output goes to a file."""

    def __init__(self, package: str, *arguments: str, log: Path):
        self.log = log
        with log.open("ab") as out:
            self.process = subprocess.Popen(
                tool(package, *arguments), cwd=ROOT, stdout=out, stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONFAULTHANDLER": "1"},  # for `wait`
            )  # fmt: skip

    def output(self) -> str:
        return self.log.read_text()

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(PATIENCE)

    def end(self, how: signal.Signals = signal.SIGTERM) -> int:
        if self.process.poll() is None:
            self.process.send_signal(how)
        return self.wait()

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its exit code. One that does not end is ended with SIGABRT, and fails with what its threads did."""
        try:
            return self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)
            self.process.wait(PATIENCE)
            raise AssertionError(f"did not end within {timeout} s\n{self.output()[-8000:]}") from None


class Stage:
    """What a test starts; everything is ended with it."""

    def __init__(self, folder: Path):
        self.folder, self.endpoint = folder, free_endpoint()
        self._processes: list[Process] = []
        self._count = 0

    def server(self, scene: Path, *arguments: str) -> Process:
        return self.start("sim_server", str(scene), "--listen", self.endpoint, *arguments)

    def worker(self, name: str = "w1", *arguments: str) -> Process:
        return self.start("precond_worker", "--connect", self.endpoint, "--name", name, *arguments)

    def start(self, package: str, *arguments: str) -> Process:
        self._count += 1
        process = Process(package, *arguments, log=self.folder / f"{self._count}-{package}.log")
        self._processes.append(process)
        return process

    @contextlib.contextmanager
    def client(self) -> Iterator[Client]:
        """A client, once the server is up. Its questions may take as long as a test waits: the machine may be full."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                client = Client(connect=[self.endpoint], timeout=1.0)
                client.timeout = PATIENCE
                break
            except ClientError:
                if time.monotonic() > deadline:
                    raise
        try:
            yield client
        finally:
            client.close()

    def close(self) -> None:
        for process in self._processes:
            if process.process.poll() is None:
                process.process.send_signal(signal.SIGCONT)
                process.end()


def until(holds: Callable[[], object], what: str, timeout: float = PATIENCE) -> None:
    """Waits until a condition holds; fails with its description."""
    deadline = time.monotonic() + timeout
    while not holds():
        assert time.monotonic() < deadline, f"not within {timeout} s: {what}"
        time.sleep(0.02)


def fresh(client: Client) -> pb.Status:
    """The status of now, where Client.status may be a second old."""
    client.command("status")
    return client.status()


def alive(pid: int) -> bool:
    """A process of this number runs."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
