# SPDX-License-Identifier: MIT
"""A server of many small beams whose loop is a clock, and a worker that answers at once.

At `rate` steps a second the loop reports a solve of each beam, whose iterations grow with the age of its factor, and
copies the matrices that were asked for. The rest is the product: the driver, the network, a worker in a process of its
own (instant_worker.py), shared memory, checks, mailboxes.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.factors_together import FactorsTogether
from sim_server.backends.kinds import Kind
from sim_server.service.service import ROUND_PERIOD
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.gpu.problem import Problem
from tests.ports import free_endpoint
from tests.support.link import link_of

MOST_STEPS = 8  # that are reported together, as the ring of a loop with a thousand bodies holds
SWING = 100.0  # steps in which an old factor becomes useless
WORST = 40.0  # iterations with such a one


class PacedLoop:
    """An engine in whose place of steps there is a clock.

    spent: processor time of its own [s]. stepping: it is at its own work
    """

    def __init__(self, sim: Simulation, rate: float):
        self._engine, self._rate, self.spent = sim.engine, rate, 0.0
        sim.engine.assemble()
        self._matrices = [sim.engine.factor_matrix(b.index).copy() for b in sim.world.bodies]
        sim.engine.solve()
        sim.engine.records()
        self.step, self._begun = int(sim.engine.step), time.monotonic()
        bodies = len(self._matrices)
        self._wanted: dict[int, NDArray[np.float64]] = {}
        self._copied = np.full(bodies, -1)
        self._factors = np.full(bodies, -1)
        self._worst = WORST * (1 + np.arange(bodies) % 8 / 8)
        self.posted, self.stepping = 0, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def request_matrix(self, body: int, target: NDArray[np.float64]) -> None:
        """Copies the matrix at the next step."""
        self._copied[body], self._wanted[body] = -1, target

    def matrix_step(self, body: int) -> int:
        """Step of the copy; -1: there is none yet."""
        return int(self._copied[body])

    def matrix_steps(self, bodies: NDArray[np.int64]) -> NDArray[np.int64]:
        """Steps of the copies of some bodies."""
        return self._copied[bodies]

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Takes factors as the engine does."""
        self._engine.post_factors(bodies, factors)
        self._factors[list(bodies)] = [factor.step for factor in factors]
        self.posted += len(bodies)

    def post_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Likewise."""
        self.post_factors(bodies, factors)

    def records_and_reactions(self) -> tuple[NDArray[Any], NDArray[np.float64]]:
        """Records of the steps that are due."""
        begin, self.stepping = time.thread_time(), True
        due = int((time.monotonic() - self._begun) * self._rate)
        made = [self._one_step() for _ in range(min(due, MOST_STEPS))]
        if due:
            self._begun = time.monotonic()
        records = np.concatenate(made) if made else np.zeros(0, RECORD)
        self.spent, self.stepping = self.spent + time.thread_time() - begin, False
        return records, np.zeros((len(records), 0, 6))

    def _one_step(self) -> NDArray[Any]:
        for body, target in self._wanted.items():
            np.copyto(target, self._matrices[body])
            self._copied[body] = self.step
        self._wanted.clear()
        self.step += 1
        made = np.zeros(len(self._factors), RECORD)
        age = np.where(self._factors >= 0, self.step - 1 - self._factors, SWING)
        made["body"], made["step"] = np.arange(len(made)), self.step
        made["iterations"] = 2 + self._worst * np.minimum(age / SWING, 1)
        made["factor_step"], made["linearizations"] = self._factors, 1
        made["kind"] = made["asked"] = np.where(self._factors >= 0, Kind.CHOLESKY, Kind.BLOCK_JACOBI)
        made["solve"], made["whole"] = 1e-5 * made["iterations"], 1 / self._rate
        return made


class Served:
    """Many beams with their server, a loop of our pace and, inside `with`, a worker that answers at once."""

    def __init__(self, beams: int, tets: int, rate: float, instant: bool = True):
        with tempfile.TemporaryDirectory() as folder:
            sim = Simulation.load(Problem(tets, beams=beams).write(Path(folder)))
        self.loop = sim.engine = PacedLoop(sim, rate)
        endpoint = free_endpoint()
        self.link = link_of(sim, endpoint, "bench")
        self.driver = Driver(sim, self.link.dispatch)
        module = "tests.bench.service.instant_worker" if instant else "precond_worker"
        self._command = [sys.executable, "-m", module, "--connect", endpoint, "--server", "bench", "--name", "instant"]

    def __enter__(self) -> Self:
        self._worker = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._worker.terminate()
        self._worker.wait()
        self.link.close()

    def round(self) -> NDArray[Any]:
        """One round of the thread that serves the loop."""
        records = self.driver.pump()
        time.sleep(ROUND_PERIOD)
        return records
