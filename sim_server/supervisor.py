# SPDX-License-Identifier: MIT
"""Local workers of `sim-server --workers N`: started, restarted within a budget, stopped with the server."""

import logging
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

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


class Supervisor:
    """Keeps `count` precond-worker processes running. connect: endpoints of the server. Call `look` now and then."""

    def __init__(
        self, count: int, server: str, connect: Sequence[str], arguments: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        endpoints = [word for endpoint in connect for word in ("--connect", endpoint)]
        self._command = [
            sys.executable, "-m", "precond_worker", "--exit-with-parent", "--server", server, *endpoints, *arguments
        ]  # fmt: skip
        self._clock = clock
        self.workers = [_Worker(f"local-{i + 1}") for i in range(count)]
        for worker in self.workers:
            self._start(worker)

    def _start(self, worker: _Worker) -> None:
        worker.process = subprocess.Popen(
            [*self._command, "--name", worker.name], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )

    def look(self) -> None:
        """Restarts what has died, after a pause that doubles; gives up on a worker that keeps dying."""
        now = self._clock()
        for worker in self.workers:
            if worker.given_up or worker.process is None or worker.process.poll() is None:
                continue
            if worker.due == 0.0:
                worker.restarts = [t for t in worker.restarts if now - t < PERIOD]
                if len(worker.restarts) >= BUDGET:
                    worker.given_up = True
                    log.error("worker %s died %d times within %g s: left alone", worker.name, BUDGET + 1, PERIOD)
                    continue
                worker.due = now + BACK_OFF * 2 ** len(worker.restarts)
                log.warning("worker %s ended with %s: restarting", worker.name, worker.process.returncode)
            if now >= worker.due:
                worker.restarts.append(now)
                worker.due = 0.0
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
