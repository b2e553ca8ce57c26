# SPDX-License-Identifier: MIT
"""Discrete events of many servers that share pools of workers through routers. No clock: all times are simulated.

A server copies its matrix at the first step after it knows that a seat of a worker is free; the copy goes through the
routers of both racks, waits at the worker, is factorized, and the factor goes back; it is used from the next step on.
Steps are no events: how old a factor is, and what that costs, follows from when it was copied.
"""

import heapq
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil, exp

import numpy as np
from numpy.typing import NDArray

from precond_worker.main_loop import POOL_PERIOD
from precond_worker.network.pool_choice import ServerNeed
from sim_server.mesh import bar
from sim_server.service.need import MEMORY, PERIOD
from tests.bench.scale.measured import Body, body, dragged, resting
from tests.bench.scale.policies import Choice, choice

MIX = ((3000, 0.02, 0.5), (7350, 0.02, 0.3), (24000, 0.05, 0.2))  # tets, s of a time step, share of the servers
CELLS = {540: (3, 3, 10), 3000: (5, 5, 20), 7350: (7, 7, 25), 24000: (10, 10, 40)}  # of the beams, by tets
LINK = 1.25e9  # bytes/s of a router
BLOCKS_OF_AN_EDGE = 2  # of a matrix: both triangles are sent
SILENCE = 2.0  # s after which a server knows that a worker is gone (ServerLink.silence)


@dataclass(frozen=True)
class Plan:
    """One run.

    pools: that servers and workers are divided into, each with names of its own
    racks: of the workers, each behind a router; servers are spread over them
    spread: the workers of a pool stand in all racks, not in one
    touched: part of the servers whose body is in a hand; for `held` s each time on average
    link: bytes a second of a router
    lost: workers of the first rack go at that time [s], and come back after `away` s
    """

    policy: str = "need"
    servers: int = 1000
    workers: int = 100
    pools: int = 10
    racks: int = 10
    spread: bool = True
    touched: float = 0.1
    held: float = 60.0
    link: float = LINK
    seconds: float = 75.0
    warm: float = 30.0
    lost: float | None = None
    away: float = 20.0
    seed: int = 0


@dataclass
class Server:
    """A server with one body. made: when the matrix of the factor in use was copied; since: when ages were noted"""

    name: str
    pool: int
    rack: int
    body: Body
    dt: float
    matrix: float  # bytes
    touched: bool = False
    made: float = 0.0
    since: float = 0.0
    smooth: float = 0.0  # as the server tells it
    workers: dict[int, float] = field(default_factory=dict)  # known to it, with their shares


@dataclass
class Worker:
    """life: number of its process; analysed: servers whose first job it has done; queue: (server, when copied)"""

    pool: int
    rack: int
    choose: Choice
    life: int = 0
    seats: tuple[str, ...] = ()
    analysed: set[str] = field(default_factory=set)
    open: set[str] = field(default_factory=set)  # servers that a job of is on its way, or here
    queue: deque[tuple[Server, float]] = field(default_factory=deque)
    busy: bool = False
    worked: float = 0.0


class Run:
    """Runs one plan. After `run`: ages (pairs of age at the begin and at the end of a time [s]), samples, counts."""

    def __init__(self, plan: Plan):
        self.plan, self.now = plan, 0.0
        self._random = random.Random(f"scale-{plan.seed}")
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self.moving, self.still = dragged(), resting()
        self.ages: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
        self.samples: list[tuple[float, float, bool]] = []  # time, s lost a second, late: of touched bodies
        self.factors = self.changes = 0
        self._routers = [0.0] * plan.racks
        self.carried = [0.0] * plan.racks  # bytes
        self._told: list[dict[str, ServerNeed]] = [{} for _ in range(plan.pools)]
        self._make()

    def _make(self) -> None:
        plan = self.plan
        kinds = {tets: body(tets) for tets, _, _ in MIX}
        matrices = {tets: matrix_bytes(tets) for tets, _, _ in MIX}
        sizes = [k for k, (_, _, share) in enumerate(MIX) for _ in range(round(share * plan.servers))]
        sizes += [0] * (plan.servers - len(sizes))
        self._random.shuffle(sizes)
        self.servers: list[Server] = []
        for k, size in enumerate(sizes[: plan.servers]):
            tets, dt, _ = MIX[size]
            self.servers.append(Server(f"s{k}", k % plan.pools, (k // plan.pools) % plan.racks, kinds[tets], dt,
                                       matrices[tets]))  # fmt: skip
        self._named = {server.name: server for server in self.servers}
        self._names = [[s.name for s in self.servers if s.pool == p] for p in range(plan.pools)]
        each = plan.workers // plan.pools
        self.workers: list[Worker] = []
        for k in range(plan.workers):
            pool = k % plan.pools
            rack = (k // plan.pools + pool) % plan.racks if plan.spread else pool % plan.racks
            chooser = choice(plan.policy, self._names[pool], k // plan.pools, each, f"{plan.seed}-{k}-0")
            self.workers.append(Worker(pool, rack, chooser))

    def at(self, time: float, what: Callable[[], None]) -> None:
        """Calls something at a time [s]."""
        self._number += 1
        heapq.heappush(self._events, (time, self._number, what))

    def run(self) -> "Run":
        """Runs to the end."""
        plan, rng = self.plan, self._random
        for server in self.servers:
            server.touched = rng.random() < plan.touched
            self.at(self._spell(server), lambda s=server: self._turn(s))  # type: ignore[misc]
            self.at(rng.random() * PERIOD, lambda s=server: self._tell(s))  # type: ignore[misc]
        for k in range(len(self.workers)):
            self.at(PERIOD + rng.random() * POOL_PERIOD, lambda k=k: self._look(k, 0))  # type: ignore[misc]
        if plan.lost is not None:
            gone = [k for k, worker in enumerate(self.workers) if worker.rack == 0]
            self.at(plan.lost, lambda: self._lose(gone))
            self.at(plan.lost + plan.away, lambda: self._bring_back(gone))
        while self._events and self._events[0][0] < plan.seconds:
            self.now, _, what = heapq.heappop(self._events)
            what()
        self.now = plan.seconds
        for server in self.servers:
            self._note(server)
        return self

    # Servers

    def _spell(self, server: Server) -> float:
        touched, held = self.plan.touched, self.plan.held
        mean = held if server.touched else held * (1 - touched) / touched
        return self.now + self._random.expovariate(1 / mean)

    def _turn(self, server: Server) -> None:
        """A hand takes hold, or lets go. The factor in use lacks its spring: its whole age counts."""
        self._note(server)
        server.touched = not server.touched
        self.at(self._spell(server), lambda: self._turn(server))

    def _note(self, server: Server) -> None:
        """Notes the ages since the last note."""
        begin = max(server.since, self.plan.warm)
        if self.now > begin:
            self.ages[server.touched].append((begin - server.made, self.now - server.made))
        server.since = self.now

    def lost(self, server: Server) -> tuple[float, bool]:
        """Time that solves lose a second, at this step, and whether the step is longer than its time."""
        motion = self.moving if server.touched else self.still
        extra = motion.excess((self.now - server.made) / server.dt) * server.body.iteration
        step = server.body.step + extra
        return extra / max(server.dt, step), step > server.dt

    def _tell(self, server: Server) -> None:
        """What sim_server/service/need.py measures and ServerLink.publish_need sends."""
        lost, late = self.lost(server)
        if server.touched and self.now >= self.plan.warm:
            self.samples.append((self.now, lost, late))
        server.smooth += (1 - exp(-PERIOD / MEMORY)) * (lost - server.smooth)
        self._told[server.pool][server.name] = ServerNeed(server.smooth, sum(server.workers.values()))
        self.at(self.now + PERIOD, lambda: self._tell(server))

    def _after_step(self, server: Server, time: float) -> float:
        return ceil(time / server.dt + 1e-9) * server.dt

    # Workers

    def _look(self, k: int, life: int) -> None:
        worker = self.workers[k]
        if worker.life != life:
            return
        before, first = set(worker.seats), not worker.seats
        worker.seats = tuple(worker.choose.update(self._told[worker.pool], self.now))
        share = 1 / len(worker.seats) if worker.seats else 0.0
        for name in before - set(worker.seats):
            self._named[name].workers.pop(k, None)
            worker.analysed.discard(name)
        for name in worker.seats:
            self._named[name].workers[k] = share
            if name not in before:
                self.changes += self.now >= self.plan.warm
                if first and self.now < self.plan.warm:
                    worker.analysed.add(name)
                if name not in worker.open:
                    self._ask(k, life, self._named[name])
        self.at(self.now + POOL_PERIOD, lambda: self._look(k, life))

    def _ask(self, k: int, life: int, server: Server) -> None:
        """A seat is free: the matrix is copied at the next step."""
        self.workers[k].open.add(server.name)
        self.at(self._after_step(server, self.now), lambda: self._send(k, life, server))

    def _send(self, k: int, life: int, server: Server) -> None:
        worker, copied = self.workers[k], self.now
        if worker.life == life:
            self._through(server.rack, worker.rack, server.matrix, lambda: self._arrive(k, life, server, copied))

    def _through(self, here: int, there: int, size: float, then: Callable[[], None]) -> None:
        """Calls when the last byte is there. A router sends one array after another."""
        self._routers[here] = end = max(self.now, self._routers[here]) + size / self.plan.link
        self.at(end, lambda: self._passed(here, there, size, then))

    def _passed(self, here: int, there: int, size: float, then: Callable[[], None]) -> None:
        self.carried[here] += size if self.now >= self.plan.warm else 0.0
        if here == there:
            then()
        else:
            self._through(there, there, size, then)

    def _arrive(self, k: int, life: int, server: Server, copied: float) -> None:
        worker = self.workers[k]
        if worker.life == life:
            worker.queue.append((server, copied))
            self._work(k)

    def _work(self, k: int) -> None:
        """Takes the next job; in the order of arrival, with one of each server at a time, all have their turn."""
        worker = self.workers[k]
        if worker.busy or not worker.queue:
            return
        server, copied = worker.queue.popleft()
        time = server.body.factor + (0.0 if server.name in worker.analysed else server.body.analysis)
        if server.name in worker.seats:
            worker.analysed.add(server.name)
        worker.busy, life = True, worker.life
        worker.worked += time if self.now >= self.plan.warm else 0.0
        self.at(self.now + time, lambda: self._done(k, life, server, copied))

    def _done(self, k: int, life: int, server: Server, copied: float) -> None:
        worker = self.workers[k]
        if worker.life != life:
            return
        worker.busy = False
        self._through(
            worker.rack, server.rack, server.body.bytes,
            lambda: self.at(self._after_step(server, self.now), lambda: self._use(k, life, server, copied)),
        )  # fmt: skip
        self._work(k)

    def _use(self, k: int, life: int, server: Server, copied: float) -> None:
        if copied > server.made:
            self._note(server)
            server.made = copied
        self.factors += self.now >= self.plan.warm
        worker = self.workers[k]
        if worker.life == life:
            worker.open.discard(server.name)
            if server.name in worker.seats:
                self._ask(k, life, server)

    def _lose(self, gone: list[int]) -> None:
        for k in gone:
            worker = self.workers[k]
            worker.life, worker.busy = worker.life + 1, False
            worker.queue.clear()
            worker.open.clear()
            worker.analysed.clear()
            seats, worker.seats = worker.seats, ()
            self.at(self.now + SILENCE, lambda k=k, seats=seats: self._forget(k, seats))  # type: ignore[misc]

    def _forget(self, k: int, seats: tuple[str, ...]) -> None:
        for name in seats:
            self._named[name].workers.pop(k, None)

    def _bring_back(self, gone: list[int]) -> None:
        """Processes that start anew, and know nothing."""
        plan = self.plan
        for k in gone:
            worker = self.workers[k]
            worker.choose = choice(
                plan.policy, self._names[worker.pool], k // plan.pools, plan.workers // plan.pools,
                f"{plan.seed}-{k}-{worker.life}",
            )  # fmt: skip
            life = worker.life
            self.at(self.now + self._random.random() * POOL_PERIOD, lambda k=k, life=life: self._look(k, life))  # type: ignore[misc]


def matrix_bytes(tets: int) -> float:
    """Of the blocks of a matrix as they are sent, 3 x 3 in float64, of a beam of so many tets."""
    mesh = bar(list(CELLS[tets]), [1.0, 1.0, 4.0])
    pairs = np.concatenate([mesh.tets[:, [a, b]] for a in range(4) for b in range(a)])
    edges = len(np.unique(np.sort(pairs, axis=1), axis=0))
    return 72.0 * (len(mesh.rest) + BLOCKS_OF_AN_EDGE * edges)


def quantiles(ages: list[tuple[float, float]], parts: tuple[float, ...]) -> list[float]:
    """Ages below which a body is for these parts of its time [s]; nan without any."""
    if not ages:
        return [float("nan")] * len(parts)
    table = np.array(ages)
    at: NDArray[np.float64] = np.unique(np.quantile(table, np.linspace(0, 1, 4001)))

    def below(ends: NDArray[np.float64]) -> NDArray[np.float64]:
        ends = np.sort(ends)
        sums = np.concatenate([[0.0], np.cumsum(ends)])
        count = np.searchsorted(ends, at, side="right")
        return count * at - sums[count]

    time = below(table[:, 0]) - below(table[:, 1])
    return [float(v) for v in np.interp(parts, time / time[-1], at)]
