# SPDX-License-Identifier: MIT
"""Policies under which no step waits: matrices go to workers, and a factor is used as soon as it is there."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim_server.arrays import Int64
from sim_server.updates.body_state import on_sent
from sim_server.updates.policies.base import UpdatePolicy
from sim_server.updates.prefetch import PrefetchDepth
from sim_server.updates.scheduler import (
    Flags,
    UpdateRequests,
    is_worthwhile,
    max_factor_age,
    overdue_after,
    pick,
)
from sim_server.updates.update_table import NONE

if TYPE_CHECKING:
    from sim_server.updates.driver import Driver

FLYING_WEIGHT = 0.02  # of the jobs that are on their way now, in their running mean
MAX_REQUESTS = 64  # matrices that the loop may be asked to copy within one step


class Async(UpdatePolicy):
    """Matrices of the most urgent bodies go to idle workers, one of a body at a time."""

    free = True
    selects = False  # `wants` leaves bodies out
    goes_ahead = True  # the next matrix of a body is sent while its last factor is checked, if there is room

    def __init__(self, driver: Driver, n: int = 0):
        super().__init__(driver, n)
        self.prefetch = PrefetchDepth()
        self._exhausted = -1  # step at which no body was left to be asked for its matrix
        self._newest_copy = -1  # that is there: number of its request
        self._choice_due = 0.0  # s; time before which `pump` chooses no bodies
        self._on_their_way = 0.0  # jobs, about, from matrix to factor

    def step(self) -> None:
        """Makes a step after an exchange with the workers."""
        self.exchange()
        self.driver.engine.run(1)

    def pump(self) -> None:
        """Makes an exchange with the workers, takes up what came meanwhile, and requests matrices."""
        source = self.driver.source
        with source.round():
            self._adapt()
            self._exchange_copies()
        with source.round():  # factors of many bodies need not wait for the records of the next round
            self.driver.receive(source, self.on_factors)
            if (begin := time.monotonic()) >= self._choice_due:
                self._choose()  # of a thousand bodies it takes milliseconds: half of the time is kept for all else
                self._choice_due = 2 * time.monotonic() - begin

    def _adapt(self) -> None:
        """Adapts the prefetch depth to the time of steps."""
        driver, source, table = self.driver, self.driver.source, self.driver.table
        if self.prefetch.on_step(driver.engine.step, time.monotonic()) and not driver.counted:
            self.prefetch.update(table.mean(table.cost), len(table), source.worker_count(), source.queues_jobs())

    def exchange(self) -> None:
        """Takes up factors, sends the matrices that were copied, requests those of the most urgent bodies."""
        self._exchange_copies()
        self._choose()

    def _exchange_copies(self) -> None:
        """Takes up factors and sends the matrices that were copied."""
        driver, source = self.driver, self.driver.source
        # Take up factors; bodies whose worker is slow may be sent again
        driver.receive(source, self.on_factors)
        for name in source.reassigned():
            driver.snapshots.release(driver.by_name[name])
            driver.by_name[name].on_reassignment()
            self.on_job_end()
        self._send_copies()
        _, flying, _ = driver.table.counts()
        self._on_their_way += FLYING_WEIGHT * (flying - self._on_their_way)

    def _choose(self) -> None:
        """Requests the matrices of the most urgent bodies."""
        driver, source, solver = self.driver, self.driver.source, self.driver.solver
        # Count the places: idle workers without a copy on the way, and copies to hold in advance
        step, (waiting, _, failing) = driver.engine.step, driver.table.counts()
        idle = max(min(source.ready(), MAX_REQUESTS) - waiting, 0)
        places = max(idle, self.prefetch.depth - waiting)
        if places <= 0 or step == self._exhausted:
            return
        # Choose the most urgent bodies, and leave the first of them to faster workers that are busy
        left, overdue = source.faster_busy_workers(), self._overdue(self._jobs())
        chosen: list[int] = []
        for ahead in (False, True) if self.goes_ahead else (False,):
            if room := left + places - len(chosen):
                requests = self._requests(ahead, failing > 0)
                if self.selects:
                    requests = requests.of(self.wants(requests, step))
                chosen += pick(requests, room, solver.update_floor_steps, solver.schedule, overdue)
        chosen = chosen[left:]
        # Request their matrices; in advance only those of bodies that need a factor, unless workers have many at a time
        table, wanted = driver.table, np.array(chosen, np.int64)
        if not self.prefetch.queued:
            needed = (table.sent[wanted] == NONE) | (table.excess[wanted] > 0)
            needed[:idle] = True
            wanted = wanted[needed]
        driver.snapshots.request_all(wanted, driver.bodies)
        if len(wanted) < places:
            self._exhausted = step

    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """Returns True for all: the scheduler decides."""
        return np.ones(len(requests), np.bool_)

    def max_age(self) -> int:
        """Returns a bound by the latencies measured so far."""
        table = self.driver.table
        if table.mean(table.latency) is None:
            return -1
        jobs = self._jobs()  # asked once: a worker may join or leave at any time
        return max_factor_age(self._overdue(jobs), self._latencies(), float(np.nanmax(table.latency)), jobs)

    def on_job_end(self) -> None:
        """Takes note that there is a body again whose matrix may be requested."""
        self._exhausted = -1

    def _requests(self, ahead: bool, failing: bool) -> UpdateRequests:
        """Returns the requests (Driver.requests) of bodies, without those that are better left for a busy worker.
        failing: jobs of any body failed since its last factor"""
        requests, source = self.driver.requests(ahead), self.driver.source
        failures = source.consecutive_failures()
        if failures is None:
            return requests
        reserved = source.reserved()
        if not (reserved or failures or failing):
            return requests
        names = [self.driver.bodies[body].body.name for body in requests.body.tolist()]
        counted = replace(requests, failures=np.array([failures.get(name, 0) for name in names], np.int64))
        return counted.of(np.array([name not in reserved for name in names], np.bool_))

    def _send_copies(self) -> None:
        """Sends copies to idle workers in the order of the requests. With a prefetch depth others wait their turn."""
        driver = self.driver
        there, steps = driver.snapshots.completed()
        bodies = there
        if self.prefetch.depth and len(bodies):
            idle = driver.source.ready()
            late = driver.engine.step - steps[idle:] > self.prefetch.patience
            self._discard(bodies[idle:][late])
            bodies, steps = bodies[:idle], steps[:idle]
        if len(bodies):
            self._send(bodies, steps)
        self._note_copies(there, time.monotonic())

    def _send(self, bodies: Int64, steps: Int64) -> None:
        """Sends the copies of some bodies, which are there, of some steps."""
        driver = self.driver
        jobs = driver.make_jobs(bodies, steps)
        if not jobs:
            return
        if len(jobs) < len(bodies):  # others were discarded
            bodies = np.array([driver.by_name[job.object].body.index for job in jobs], np.int64)
            steps = np.array([job.step for job in jobs], np.int64)
        taken = np.array(driver.source.submit_many(jobs), np.bool_)
        on_sent(driver.table, bodies[taken], steps[taken])
        self._discard(bodies[~taken])

    def _note_copies(self, bodies: Int64, now: float) -> None:
        """Takes note of how long it took until copies could be sent that are there, in the order of their requests."""
        table = self.driver.table
        if len(new := bodies[table.request[bodies] > self._newest_copy]):
            self._newest_copy = int(table.request[new[-1]])
            self.prefetch.on_copy(now - float(table.requested[new].mean()))

    def _discard(self, bodies: Int64) -> None:
        for body in bodies.tolist():
            self.driver.snapshots.discard(self.driver.bodies[body])

    def _jobs(self) -> float:
        """Number of jobs on their way at a time, one at each worker at least; 0 without workers."""
        workers = self.driver.source.worker_count()
        return max(workers, self._on_their_way) if workers else 0

    def _overdue(self, jobs: float) -> float:
        """Returns the steps after which a body goes next whatever the rule; inf without workers."""
        solver = self.driver.solver
        return max(overdue_after(solver.schedule_rounds, self._latencies(), jobs), solver.update_floor_steps)

    def _latencies(self) -> float:
        """Returns the steps from matrix to factor of all bodies together; unknown ones are the mean of others."""
        table = self.driver.table
        mean = table.mean(table.latency)
        return len(table) * (1.0 if mean is None else mean)


class Adaptive(Async):
    """As Async, but a matrix is sent only once the excess iterations have cost as much as a factorization."""

    selects = True
    goes_ahead = False  # what was lost is lost to the factor that is about to be replaced

    def wants(self, requests: UpdateRequests, step: int) -> Flags:
        """True where a new factor is worth its time (scheduler.is_worthwhile)."""
        return is_worthwhile(requests, self.driver.solver.update_threshold)

    def max_age(self) -> int:
        """Returns -1: no age makes a factor too old."""
        return -1
