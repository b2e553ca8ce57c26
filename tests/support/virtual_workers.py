# SPDX-License-Identifier: MIT
"""Workers whose time is counted in steps: runs with them repeat to the digit on any machine."""

from collections.abc import Callable
from math import ceil

from protocol.factor import Factor
from sim_server.simulation import Simulation
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.stats import flops


class VirtualWorkers(Inline):
    """So many workers, each at one matrix at a time. A factor is made in this process when its matrix is submitted,
    and comes as many steps later as its operations take at `speed` [operations per step], one at least."""

    def __init__(self, simulation: Simulation, workers: int, speed: float):
        bodies, engine = simulation.world.bodies, simulation.engine
        super().__init__({b.name: simulation.system.body_pattern(b.first, b.last) for b in bodies})
        self._step: Callable[[], int] = lambda: engine.step
        self._count, self._speed = workers, speed
        self._working: list[tuple[int, Factor]] = []

    def worker_count(self) -> int:
        return self._count

    def ready(self) -> int:
        return self._count - len(self._working)

    def submit(self, job: Job) -> bool:
        if self.ready() <= 0:
            return False
        super().submit(job)
        self._working += [(self._step() + self.steps(factor), factor) for factor in super().poll()]
        return True

    def steps(self, factor: Factor) -> int:
        """How long a worker is busy with it."""
        return max(1, ceil(flops(factor.pattern) / self._speed))

    def poll(self) -> list[Factor]:
        now = self._step()
        done = [factor for at, factor in self._working if at <= now]
        self._working = [(at, factor) for at, factor in self._working if at > now]
        return done
