# SPDX-License-Identifier: MIT
"""The processes of a load test: the server that it starts, and those of the clients. All end with the test."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from clients.client import Client
from clients.errors import ClientError
from protocol.process.own_python import own_module

START_TIMEOUT = 120.0  # s for a server to start: many bodies, kernels to compile
END_TIMEOUT = 15.0  # s for a process to end before it is killed
CLIENTS_PER_PROCESS = 16  # at most, while there are cores for more processes


def free_endpoint() -> str:
    """Returns a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def server(scene: Path, log: Path, name: str, endpoint: str, workers: int, device: str) -> Iterator[None]:
    """Runs `sim-server` in real time, with a log, for the block. Raises ClientError if it fails to start."""
    output = log.with_suffix(".txt")
    command = [
        *own_module("sim_server", str(scene), "--record", str(log), "--name", name),
        *("--listen", endpoint, "--workers", str(workers), "--device", device),
    ]
    if device == "gpu":
        command += ["--worker-device", "auto"]
    with output.open("wb") as out:  # in a session of its own: Ctrl-C reaches this process alone, which ends the server
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        _await(process, name, endpoint, output)
        yield
    finally:
        end(process)


def _await(process: subprocess.Popen[bytes], name: str, endpoint: str, output: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while True:
        try:
            with Client(name, [endpoint], timeout=1.0) as client:
                if client.status().step > 0:
                    return
        except ClientError:
            pass
        if process.poll() is not None:
            said = output.read_text(errors="replace").strip().splitlines()[-5:]
            raise ClientError("the server ended before it began:\n" + "\n".join(said))
        if time.monotonic() > deadline:
            raise ClientError(f"the server did not start within {START_TIMEOUT:g} s; what it said: {output}")
        time.sleep(0.05)


def end(process: subprocess.Popen[Any]) -> None:
    """Ends a process by SIGTERM, and by SIGKILL after END_TIMEOUT."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def process_count(clients: int) -> int:
    """Number of processes for `clients` clients: one per CLIENTS_PER_PROCESS, at most one per core."""
    return max(1, min(-(-clients // CLIENTS_PER_PROCESS), os.cpu_count() or 1))


class ClientProcesses:
    """Processes (client_process.py) with the clients of `plans` on one server; connected once it is entered."""

    def __init__(self, plans: list[dict[str, Any]], name: str, connect: list[str], seconds: float):
        self._plans, self._name, self._connect, self._seconds = plans, name, connect, seconds
        self._processes: list[subprocess.Popen[str]] = []
        self._closing = ExitStack()

    def __enter__(self) -> ClientProcesses:
        count = process_count(len(self._plans)) if self._plans else 0
        with self._closing as closing:
            for number in range(count):
                process = subprocess.Popen(
                    own_module("clients.load_test.client_process"),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    start_new_session=True,
                )
                closing.callback(self._end, process)
                self._processes.append(process)
                plan = {"server": self._name, "connect": self._connect, "seconds": self._seconds}
                self._tell(process, json.dumps({**plan, "clients": self._plans[number::count]}))
            for process in self._processes:
                self._line(process)
            self._closing = closing.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()

    def begin(self) -> None:
        """Lets the clients begin."""
        for process in self._processes:
            self._tell(process, "go")

    def reports(self) -> list[dict[str, Any]]:
        """Waits for the end and returns the reports of all clients. Raises ClientError if a process failed."""
        return [client for process in self._processes for client in json.loads(self._line(process))["clients"]]

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        for pipe in (process.stdin, process.stdout):  # the process may wait at either
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()
        end(process)

    @staticmethod
    def _tell(process: subprocess.Popen[str], line: str) -> None:
        assert process.stdin is not None
        try:
            process.stdin.write(line + "\n")
            process.stdin.flush()
        except BrokenPipeError:
            raise ClientError("a process of clients ended early") from None

    @staticmethod
    def _line(process: subprocess.Popen[str]) -> str:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line:
            raise ClientError("a process of clients ended early")
        return line
