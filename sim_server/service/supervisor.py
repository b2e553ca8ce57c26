# SPDX-License-Identifier: MIT
"""Local workers of `sim-server --workers N`: started, restarted within a budget, stopped with the server.

A worker that ends is started again after a pause that doubles with each restart in the last PERIOD; with more than
BUDGET of them it is left alone. The simulation goes on whatever happens to its workers.
"""

import logging
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence

from protocol.messages_pb2 import LocalWorker

log = logging.getLogger(__name__)

BUDGET = 5  # restarts of one worker ...
PERIOD = 60.0  # ... within so many seconds; more, and it is left alone
BACK_OFF = 0.2  # s before the first restart, doubled each time


class _Worker:
    def __init__(self, name: str):
        self.name = name
        self.process: subprocess.Popen[bytes] | None = None
        self.restarts: list[float] = []
        self.due = 0.0
        self.given_up = False
        self.count = 0  # restarts in all
        self.exit_code = 0

    def report(self) -> LocalWorker:
        """For the status."""
        state = "given up" if self.given_up else "restarting" if self.due else "running"
        pid = self.process.pid if self.process is not None else 0
        return LocalWorker(worker=self.name, state=state, pid=pid, restarts=self.count, exit_code=self.exit_code)


Start = Callable[[Sequence[str]], "subprocess.Popen[bytes]"]


def worker_process(command: Sequence[str], env: Mapping[str, str] | None = None) -> "subprocess.Popen[bytes]":
    """A worker that neither reads nor prints. env: None: ours."""
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=env)


class Supervisor:
    """Keeps `count` precond-worker processes running. connect: endpoints of the server. Call `look` now and then."""

    def __init__(
        self, count: int, server: str, connect: Sequence[str], arguments: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic, start: Start = worker_process,
    ):  # fmt: skip
        endpoints = [word for endpoint in connect for word in ("--connect", endpoint)]
        self._command = [
            sys.executable, "-m", "precond_worker", "--exit-with-parent", "--server", server, *endpoints, *arguments
        ]  # fmt: skip
        self._clock, self._popen = clock, start
        self.workers = [_Worker(f"local-{i + 1}") for i in range(count)]
        for worker in self.workers:
            self._start(worker)

    def _start(self, worker: _Worker) -> None:
        worker.process = self._popen([*self._command, "--name", worker.name])

    def report(self) -> list[LocalWorker]:
        """All of them, alive or not."""
        return [worker.report() for worker in self.workers]

    def look(self) -> None:
        """Restarts what has died, after a pause that doubles; gives up on a worker that keeps dying."""
        now = self._clock()
        for worker in self.workers:
            if worker.given_up or worker.process is None or worker.process.poll() is None:
                continue
            if worker.due == 0.0:
                worker.exit_code = worker.process.returncode
                worker.restarts = [t for t in worker.restarts if now - t < PERIOD]
                if len(worker.restarts) >= BUDGET:
                    worker.given_up = True
                    log.error(
                        "worker %s ended %d times within %g s, the last time with %s: left alone",
                        worker.name, BUDGET + 1, PERIOD, worker.exit_code,
                    )  # fmt: skip
                    continue
                worker.due = now + BACK_OFF * 2 ** len(worker.restarts)
                log.warning(
                    "worker %s ended with %s: starting it again in %.1f s (restart %d of %d within %g s)",
                    worker.name, worker.exit_code, worker.due - now, len(worker.restarts) + 1, BUDGET, PERIOD,
                )  # fmt: skip
            if now >= worker.due:
                worker.restarts.append(now)
                worker.due = 0.0
                worker.count += 1
                self._start(worker)

    def close(self) -> None:
        """Ends all workers: SIGTERM, then SIGKILL after two seconds."""
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
