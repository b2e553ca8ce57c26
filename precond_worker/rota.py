# SPDX-License-Identifier: MIT
"""One process for several servers: a job of each in turn."""

import threading
from collections import deque

from precond_worker.worker import Worker


class Rota:
    """Round robin over the servers that have jobs waiting; a server with none is passed over.

    Each server sends a worker one job at a time, so that none waits for more than one job of each of the others.
    bell: set by whatever arrives (uplinks, new servers).
    """

    def __init__(self, bell: threading.Event):
        self.bell = bell
        self.workers: deque[Worker] = deque()

    def add(self, worker: Worker) -> None:
        """One more server to work for."""
        self.workers.append(worker)
        self.bell.set()

    def step(self, timeout: float) -> None:
        """Take in what came, waiting up to timeout seconds for it, and do one job."""
        if not any(worker.waiting for worker in self.workers):
            self.bell.wait(timeout)
        self.bell.clear()  # before looking, so that nothing is missed
        for worker in self.workers:
            worker.take_in(0.0)
        for _ in range(len(self.workers)):
            self.workers.rotate(-1)
            if self.workers[-1].work():
                return
