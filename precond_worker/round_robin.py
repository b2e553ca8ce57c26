# SPDX-License-Identifier: MIT
"""One process for several servers: one job of each in turn."""

import threading
from collections import deque

from precond_worker.worker import Worker


class RoundRobin:
    """Round robin over the servers with waiting jobs.

    Each server sends a worker one job at a time, or several of small objects, of which those that are factorized
    together count as one: so none waits for more than one job of each of the others.
    wake: set by whatever is received, and by new servers.
    """

    def __init__(self, wake: threading.Event):
        self.wake = wake
        self.workers: deque[Worker] = deque()

    def add(self, worker: Worker) -> None:
        """Adds a server, by its worker."""
        self.workers.append(worker)
        self.wake.set()

    def remove(self, worker: Worker) -> None:
        """Removes a server."""
        self.workers.remove(worker)

    def step(self, timeout: float) -> None:
        """Takes in what was received, waiting up to `timeout` seconds for it, and does one job."""
        if not any(worker.waiting for worker in self.workers):
            self.wake.wait(min([timeout, *(worker.pause for worker in self.workers)]))
        self.wake.clear()  # before the queues are read, so that nothing is missed
        for worker in self.workers:
            worker.take_in(0.0)
        for _ in range(len(self.workers)):
            self.workers.rotate(-1)
            *others, worker = self.workers
            if worker.waiting:
                for other in others:
                    other.finish()  # its factors are not to wait for this job
                worker.work()
                return
