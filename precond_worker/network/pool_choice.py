# SPDX-License-Identifier: MIT
"""Which servers a worker of a pool works for: those with the largest need, with hysteresis. No clock, no I/O.

A server says how much time its solves lose to factors that are old or missing, and how many workers it has; with twice
as many workers a factor is half as old, so the product of the two, its demand, says what it could use, however many it
has.
A seat is worth demand / workers to who has it, demand / (workers + 1) to who takes one more (the rule of D'Hondt, by
which shares become proportional to demands). A worker changes its seat when another is worth MARGIN times as much for a
while: a random one, and longer the more workers there are that may see the same, so that they do not all go at once.
A server with a need that nobody serves comes first, and none is left alone for another.

Where servers with a need outnumber the workers, a worker has several seats and does a job of each in turn.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, exp, inf

MARGIN = 1.3  # that another seat must be worth more
PATIENCE = 1.0  # s that it must be so at least
REST = 5.0  # s between two changes of a worker
FEEDBACK = 1.0  # s after which the others see a change
MEMORY = 3.0  # s over which needs are averaged
FEWEST = 0.5  # workers that a server without any is reckoned with
LEAST = 1e-3  # s lost a second, below which a server has no need
LATE = 0.01  # servers for each worker, by which counts that were told late may be off
MOST_SEATS = 64


@dataclass(frozen=True)
class ServerNeed:
    """What a server says.

    lost: time that solves lose to old or missing factors [s a second]
    workers: that serve it; one that serves several servers is shared among them
    """

    lost: float
    workers: float


class PoolChoice:
    """The choice of one worker. seed: of the random times after which it acts

    seats: names of the servers that it serves
    changes: number so far
    """

    def __init__(self, seed: int | str):
        self._random = random.Random(seed)
        self.seats: tuple[str, ...] = ()
        self.changes = 0
        self._demands: dict[str, float] = {}
        self._seen: float | None = None
        self._wish: tuple[str, str] | None = None  # seat to leave, seat to take; "": none
        self._due = self._rested = float("-inf")

    def update(self, servers: Mapping[str, ServerNeed], now: float) -> tuple[str, ...]:
        """Returns the servers to serve. servers: all that are there, by name; now: monotonic time [s]"""
        self._average(servers, now)
        left = tuple(name for name in self.seats if name in servers)
        if left != self.seats:
            self.seats, self._wish = left, None
        if not self.seats:
            self._take_any(servers, now)
        wish = self._wanted(servers)
        if wish is None or now < self._rested:
            self._wish = None
        elif self._wish is None:
            self._wish, self._due = wish, now + PATIENCE + self._random.random() * self._spread(servers, *wish)
        elif now >= self._due:
            leave, take = wish  # what is best now, which may be another than when the wish began
            self.seats = (*(name for name in self.seats if name != leave), *([take] if take else ()))
            self._changed(now)
        return self.seats

    def _average(self, servers: Mapping[str, ServerNeed], now: float) -> None:
        fresh = 1.0 if self._seen is None else 1 - exp(-max(now - self._seen, 0.0) / MEMORY)
        self._seen = now
        known = self._demands
        self._demands = {}
        for name, server in servers.items():
            demand = max(server.lost, 0.0) * max(server.workers, FEWEST)
            self._demands[name] = known[name] + fresh * (demand - known[name]) if name in known else demand

    def _count(self, servers: Mapping[str, ServerNeed]) -> int:
        """Seats of this worker: servers with a need over workers, rounded up."""
        needy = sum(demand > LEAST for demand in self._demands.values())
        workers = max(sum(server.workers for server in servers.values()), 1.0)
        return min(max(ceil(needy / workers - LATE), 1), MOST_SEATS)

    def _worth(self, servers: Mapping[str, ServerNeed], name: str, share: float) -> float:
        """What a seat is worth to this worker, which has it or would take it."""
        workers, demand = servers[name].workers, self._demands[name]
        if name in self.seats:
            alone = workers < 1.5 * share and demand > LEAST
            return inf if alone else demand / max(workers, share)
        return inf if workers < 0.5 * share else demand / (workers + share)

    def _wanted(self, servers: Mapping[str, ServerNeed]) -> tuple[str, str] | None:
        """Returns the change that pays: (seat to leave, seat to take), "" for none; None: no change does."""
        count = self._count(servers)
        worth = {name: self._worth(servers, name, 1 / count) for name in servers}
        others = [name for name in servers if name not in self.seats and self._demands[name] > LEAST]
        order = {name: (worth[name], self._demands[name]) for name in servers}  # among those without a worker, too
        best = max(others, key=order.__getitem__, default="")
        worst = min(self.seats, key=order.__getitem__, default="")
        if len(self.seats) > count:
            return (worst, "") if worth[worst] < inf else None
        if len(self.seats) < count:
            return ("", best) if best else None
        if best and worst and worth[worst] < inf and worth[best] > MARGIN * worth[worst]:
            return worst, best
        return None

    def _spread(self, servers: Mapping[str, ServerNeed], leave: str, take: str) -> float:
        """Returns the longest random time before a change [s].

        So long that, of all who may want the same, no more act within FEEDBACK than are to act at all.
        """
        total = sum(self._demands.values()) or 1.0
        workers = sum(server.workers for server in servers.values())
        rivals = servers[leave].workers if leave else workers
        missing = workers * self._demands[take] / total - servers[take].workers if take else 1.0
        return 2 * FEEDBACK * max(rivals / max(missing, 1.0), 1.0)

    def _take_any(self, servers: Mapping[str, ServerNeed], now: float) -> None:
        """Takes a first seat by lot, as many workers may start at once, or lose their server."""
        if servers:
            names = sorted(servers)
            chances = [self._demands[name] / (servers[name].workers + 1) + LEAST for name in names]
            self.seats = (self._random.choices(names, chances)[0],)
            self._changed(now)

    def _changed(self, now: float) -> None:
        self.changes += 1
        self._wish, self._rested = None, now + REST
