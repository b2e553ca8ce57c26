# SPDX-License-Identifier: MIT
"""The deterministic twin of `async`: a factor is used exactly n steps after the step of its matrix."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from protocol.factor import Factor
from sim_server.updates.body_state import BodyUpdateState
from sim_server.updates.factor_source import Job
from sim_server.updates.policies.base import UpdatePolicy
from sim_server.updates.scheduler import Flags, UpdateRequests

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

log = logging.getLogger(__name__)

POLL_PERIOD = 2e-4  # s between looks at whether a factor or an idle worker is there
WARN_PERIOD = 5.0  # s of waiting for a factor between two warnings
JOIN_TIME = 1.0  # s for which a matrix waits for a worker to join before it is factorized here


class Lockstep(UpdatePolicy):
    """Matrices go to workers; the factor of step t is used from step t + n on, and then the next matrix is sent."""

    def __init__(self, driver: Driver, n: int):
        super().__init__(driver, n)
        self._due: dict[str, int] = {}  # objects with a job, and the steps of their matrices
        self._arrived: dict[tuple[str, int], Factor] = {}  # by object and step
        self._saved: Sequence[Job] = ()  # in flight when the run was saved
        self._without_workers = False  # the last matrix was factorized in this process

    def step(self) -> None:
        """Uses the factors that are due, makes a step, and sends the matrices of bodies without a job."""
        driver, engine = self.driver, self.driver.engine
        now = engine.step
        for job in self._saved:
            state = driver.by_name[job.object]
            state.job.set_copy(job.values)
            state.on_job(job.step, job.method)
            if self._submit(state, job):
                self._due[job.object] = job.step
        self._saved = ()
        for name, made in list(self._due.items()):
            if made + self.n == now:
                self._use(name, made)
        requests = driver.requests()
        wanted = [driver.bodies[body] for body in requests.body[self.wants(requests, now)].tolist()]
        for state in wanted:
            driver.snapshots.request(state)
        engine.run(1)
        if engine.step == now:
            return  # stopped
        for state in wanted:
            if self._send(state):
                self._due[state.body.name] = now

    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """True where the body has no job."""
        bodies = self.driver.bodies
        return np.array([bodies[body].body.name not in self._due for body in requests.body.tolist()], np.bool_)

    def max_age(self) -> int:
        """Returns 2 n - 1: a factor is n steps old when it comes, and stays for n steps."""
        return 2 * self.n - 1

    def on_factors(self, factors: Sequence[Factor]) -> None:
        """Keeps factors until they are due."""
        for factor in factors:
            self._arrived[factor.object, factor.step] = factor

    def take_back(self, jobs: Sequence[Job]) -> None:
        """Has the jobs sent again before the next step."""
        self._saved = jobs

    def expected_latency(self, state: BodyUpdateState) -> float:
        """Returns n."""
        return float(self.n)

    def _use(self, name: str, made: int) -> None:
        """Waits for the factor of the step `made`. If its job fails, the body goes on with the factor it has."""
        driver, begun = self.driver, time.monotonic()
        while (name, made) not in self._arrived and driver.by_name[name].job.in_flight:
            self._collect()
            if (name, made) in self._arrived or driver.engine.loop.stop:
                break
            if time.monotonic() - begun > WARN_PERIOD:
                log.warning("object %r: lockstep waits for the factor of step %d", name, made)
                begun = time.monotonic()
            time.sleep(POLL_PERIOD)
        if factor := self._arrived.pop((name, made), None):
            driver.adopt([factor])
            driver.engine.settle_factors()
        for late in [key for key in self._arrived if key[0] == name]:  # of a job that was given up
            del self._arrived[late]
        self._due.pop(name)

    def _collect(self) -> None:
        for source in {id(s): s for s in (self.driver.source, self.driver.inline)}.values():
            self.driver.receive(source, self.on_factors)

    def _send(self, state: BodyUpdateState) -> bool:
        """Sends the copied matrix to a worker as soon as one is idle; factorizes it in this process if there is no
        worker at all. False: the loop was stopped, or the copy does not suffice."""
        job = self.driver.make_job(state)
        return job is not None and self._submit(state, job)

    def _submit(self, state: BodyUpdateState, job: Job) -> bool:
        driver, source = self.driver, self.driver.source
        begun = time.monotonic()
        while not (source.ready() and source.submit(job)):
            if driver.engine.loop.stop:
                driver.snapshots.discard(state)
                return False
            self._collect()
            joining = not self._without_workers and time.monotonic() - begun < JOIN_TIME
            if not joining and not source.worker_count():
                if not self._without_workers:
                    log.warning("lockstep without a worker: factors are made in this process")
                self._without_workers = True
                driver.inline.submit(job)
                break
            time.sleep(POLL_PERIOD)
        else:
            self._without_workers = False
        state.on_sent(job.step)
        return True
