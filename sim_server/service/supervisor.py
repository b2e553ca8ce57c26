# SPDX-License-Identifier: MIT
"""Starts, restarts and stops the local workers of `sim-server --workers N`.

A worker that ends is started again after a pause that doubles with each restart in the last RESTART_PERIOD; after
MAX_RESTARTS of them it is given up. The simulation goes on without it. Clients may add workers, up to MAX_WORKERS in
all, and kill them.
"""

import logging
import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence

from protocol.messages_pb2 import LocalWorker
from protocol.process.own_python import own_module

log = logging.getLogger(__name__)

MAX_WORKERS = 64  # of one server: as many as `--workers` takes
MAX_RESTARTS = 5  # of one worker within RESTART_PERIOD
RESTART_PERIOD = 60.0  # s
BACK_OFF = 0.2  # s before the first restart, doubled each time


class WorkerError(ValueError):
    """A worker that cannot be added or killed; the text goes back to the client."""


class _Process:
    def __init__(self, name: str):
        self.name = name
        self.process: subprocess.Popen[bytes] | None = None
        self.restarts: list[float] = []
        self.due = 0.0
        self.given_up = False
        self.count = 0  # restarts in all
        self.exit_code = 0

    def status(self) -> LocalWorker:
        """Returns its state as a message."""
        state = "given up" if self.given_up else "restarting" if self.due else "running"
        pid = self.process.pid if self.process is not None else 0
        return LocalWorker(worker=self.name, state=state, pid=pid, restarts=self.count, exit_code=self.exit_code)


Start = Callable[[Sequence[str]], "subprocess.Popen[bytes]"]


def worker_process(command: Sequence[str], env: Mapping[str, str] | None = None) -> "subprocess.Popen[bytes]":
    """Starts a worker without input and output. env: environment; None: that of this process."""
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=env)


class Supervisor:
    """Keeps `count` precond-worker processes running, as long as `check` is called.

    server, connect: name and endpoints of the server
    arguments: further options of the workers
    """

    def __init__(
        self, count: int, server: str, connect: Sequence[str], arguments: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic, start: Start = worker_process,
    ):  # fmt: skip
        endpoints = [word for endpoint in connect for word in ("--connect", endpoint)]
        self._command = own_module(
            "precond_worker", "--exit-with-parent", "--parent", str(os.getpid()), "--server", server, *endpoints,
            *arguments,
        )  # fmt: skip
        self._clock, self._popen = clock, start
        self.workers = [_Process(f"local-{i + 1}") for i in range(count)]
        for worker in self.workers:
            self.start(worker)

    def start(self, worker: _Process) -> None:
        """Starts the process of a worker, maybe again."""
        worker.process = self._popen([*self._command, "--name", worker.name])

    def local_workers(self) -> list[LocalWorker]:
        """Returns the state of all local workers, alive or not."""
        return [worker.status() for worker in self.workers]

    def add(self) -> str:
        """Starts one more worker, or one again that was given up; returns its name. Raises WorkerError."""
        worker = next((w for w in self.workers if w.given_up), None)
        if worker is None and len(self.workers) >= MAX_WORKERS:
            raise WorkerError(f"there are {MAX_WORKERS} local workers; allowed are at most {MAX_WORKERS}")
        if worker is None:
            worker = _Process(f"local-{len(self.workers) + 1}")
        try:
            self.start(worker)
        except OSError as error:
            raise WorkerError(f"worker {worker.name} cannot be started: {error}") from error
        if worker.given_up:
            worker.given_up, worker.restarts = False, []
            worker.count += 1
        else:
            self.workers.append(worker)
        return worker.name

    def kill(self, name: str) -> None:
        """Ends the process of a worker by SIGKILL; `check` restarts it as after any death. Raises WorkerError."""
        worker = next((w for w in self.workers if w.name == name), None)
        if worker is None:
            raise WorkerError(f"no local worker {name!r}; there is {', '.join(w.name for w in self.workers)}")
        if worker.process is None or worker.process.poll() is not None:
            raise WorkerError(f"worker {name} has no process now: it is {worker.status().state}")
        worker.process.kill()

    def check(self) -> None:
        """Restarts workers that have ended, after a pause that doubles; gives up one that keeps ending."""
        now = self._clock()
        for worker in self.workers:
            if worker.given_up or worker.process is None or worker.process.poll() is None:
                continue
            if worker.due == 0.0:
                worker.exit_code = worker.process.returncode
                worker.restarts = [t for t in worker.restarts if now - t < RESTART_PERIOD]
                if len(worker.restarts) >= MAX_RESTARTS:
                    worker.given_up = True
                    log.error(
                        "worker %s ended %d times within %g s, the last time with %s: left alone",
                        worker.name, MAX_RESTARTS + 1, RESTART_PERIOD, worker.exit_code,
                    )  # fmt: skip
                    continue
                worker.due = now + BACK_OFF * 2 ** len(worker.restarts)
                log.warning(
                    "worker %s ended with %s: starting it again in %.1f s (restart %d of %d within %g s)",
                    worker.name, worker.exit_code, worker.due - now, len(worker.restarts) + 1, MAX_RESTARTS,
                    RESTART_PERIOD,
                )  # fmt: skip
            if now >= worker.due:
                worker.restarts.append(now)
                worker.due = 0.0
                worker.count += 1
                self.start(worker)

    def close(self) -> None:
        """Ends all workers by SIGTERM, and by SIGKILL after two seconds."""
        running = [w.process for w in self.workers if w.process is not None and w.process.poll() is None]
        for process in running:
            process.terminate()
        end = time.monotonic() + 2
        for process in running:
            try:
                process.wait(max(end - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
