# SPDX-License-Identifier: MIT
"""What the same workers could do at best, were everything known beforehand.

The matrices of a run do not depend on the preconditioner (each solve ends within the same tolerance). So one run gives
them all, a table C[k, t, s] = iterations of object k in step t with the factor of its matrix of step s follows from
solving each again with each older factor, and the best order of jobs is a search through that table: beam search, so
what it finds can be done, and is hardly beaten. Resting objects need the same with any factor; they take no turns here.
"""

import heapq
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from sim_server.driver import Driver
from sim_server.engine import NativeFactor
from sim_server.factors import Job
from sim_server.simulation import Simulation
from tests.bench.scheduler.few_wild import Load, is_wild, scene
from tests.support.virtual_workers import VirtualWorkers

WIDTH = 100  # states that are kept from step to step
CHOICES = 40  # of jobs to begin in one step
SIGHT = 6  # steps that a state is judged by beyond the present one
State = tuple[tuple[int, ...], tuple[tuple[int, int, int], ...]]
"""Steps of the factors in use; jobs under way: (step in which the factor is there, object, step of its matrix)."""


class Clairvoyant:
    """The table of one load. warm: steps before those that count; speed: as in VirtualWorkers."""

    def __init__(self, objects: int, steps: int, warm: int, hold: int, speed: float, seed: int):
        self._sim = Simulation(scene(objects, woodbury=0))
        self._load, self._driver = Load(self._sim, hold, seed), Driver(self._sim, counted=True)
        self._wild = [k for k in range(objects) if is_wild(k)]
        first, *rest = self._steps(steps + warm)
        self.services = [VirtualWorkers(self._sim, 1, speed).steps(factor) for factor in first[0]]
        self.warm = warm
        rows = [first, *rest]
        self.resting = int(sum(np.delete(row[2], self._wild).sum() for row in rows[warm:]))
        self.counts = np.zeros((len(self._wild), len(rows), len(rows)), int)
        for k in range(len(self._wild)):
            made = [NativeFactor(row[0][k].pattern, row[0][k].values, t) for t, row in enumerate(rows)]
            for t, row in enumerate(rows):
                self.counts[k, t, : t + 1] = [iterations(*row[1][k], factor) for factor in made[: t + 1]]

    def _steps(self, steps: int) -> Iterator[tuple[list[Any], list[Any], NDArray[Any]]]:
        """Of each step: factors and systems of the wild objects, iterations of all with a factor of the step."""
        driver, system, bodies = self._driver, self._sim.system, self._sim.world.bodies
        for step in range(steps):
            self._load.act()
            driver.engine.assemble()
            for body in bodies:
                driver.inline.submit(Job(body.name, 1, step, True, system.body_values(body.first, body.last)))
            factors = driver.inline.poll()
            systems = [_system(self._sim, k) for k in self._wild]
            for body, factor in zip(bodies, factors, strict=True):
                driver.engine.post_factor(body.index, factor.pattern, factor.values, step)
            driver.engine.solve()
            yield [factors[k] for k in self._wild], systems, driver.engine.records()["iterations"].astype(int)

    def best(self, workers: int, width: int = WIDTH) -> int:
        """Iterations of all objects in the steps that count, in the best order of jobs that was found."""
        states: dict[State, int] = {((0,) * len(self._wild), ()): 0}
        for t in range(self.counts.shape[1]):
            after: dict[State, int] = {}
            for (used, jobs), cost in states.items():
                held = list(used)
                for _, k, s in (job for job in jobs if job[0] <= t):
                    held[k] = s
                under_way = tuple(job for job in jobs if job[0] > t)
                total = cost + (sum(self.counts[k, t, s] for k, s in enumerate(held)) if t >= self.warm else 0)
                for chosen in self._choices(t, held, under_way, workers):
                    state = tuple(held), chosen
                    after[state] = min(total, after.get(state, total))
            states = dict(heapq.nsmallest(width, after.items(), key=lambda item: item[1] + self._ahead(t, item[0])))
        return self.resting + min(states.values())

    def _choices(self, t: int, held: list[int], jobs: tuple, workers: int) -> list[tuple]:
        """What may be under way from step t on: a matrix is copied in it, sent in the next one."""
        found = [jobs]
        for _ in range(workers - len(jobs)):
            more = {
                tuple(sorted((*now, (t + 1 + self.services[k], k, t))))
                for now in found
                for k in range(len(held))
                if k not in {job[1] for job in now}
            }
            found = sorted({*found, *more}, key=lambda now: (-self._saved(t, held, now), now))[:CHOICES]
        return found

    def _saved(self, t: int, held: list[int], jobs: tuple) -> int:
        last = self.counts.shape[1] - 1
        there = [(min(at, last), k, s) for at, k, s in jobs if s == t]
        return int(sum(self.counts[k, at, held[k]] - self.counts[k, at, s] for at, k, s in there))

    def _ahead(self, t: int, state: State) -> int:
        """Iterations of the next few steps with what is in use and under way."""
        coming = {k: (at, s) for at, k, s in state[1]}
        cost = 0
        for u in range(t + 1, min(t + 1 + SIGHT, self.counts.shape[1])):
            for k, s in enumerate(state[0]):
                at, new = coming.get(k, (u + 1, s))
                cost += int(self.counts[k, u, new if at <= u else s])
        return cost


def _system(sim: Simulation, body: int) -> tuple[Any, NDArray[Any], NDArray[Any]]:
    """A, b and the start of the solve of one object, copied."""
    b, s = sim.world.bodies[body], sim.system
    row_start, columns = s.body_pattern(b.first, b.last)
    matrix = bsr_array((s.body_values(b.first, b.last).copy(), columns, row_start)).tocsr()
    return matrix, s.b_material[b.nodes].ravel().copy(), s.y[b.nodes].ravel().copy()


def iterations(
    matrix: Any, b: NDArray[Any], start: NDArray[Any], factor: NativeFactor, tolerance: float = 1e-6, most: int = 1000
) -> int:
    """Of the conjugate gradient method as native/pcg.h counts them."""
    goal, r = tolerance**2 * (b @ b), b - matrix @ start
    r2 = r @ r
    if not r2 < b @ b:
        r, r2 = b.copy(), b @ b
    count, rz, p = 0, 1.0, np.zeros_like(r)
    while r2 > goal and count < most:
        z = factor.apply(r / np.sqrt(r2)) * np.sqrt(r2)
        zr = z @ r
        p = z + (zr / rz if count else 0.0) * p
        rz, q = zr, matrix @ p
        r -= zr / (p @ q) * q
        r2, count = r @ r, count + 1
    return count
