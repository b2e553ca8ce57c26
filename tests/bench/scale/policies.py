# SPDX-License-Identifier: MIT
"""How workers of a pool choose servers: as the product does, and three others to compare with."""

import random
from collections.abc import Mapping, Sequence
from typing import Protocol

from precond_worker.network.pool_choice import REST, PoolChoice, ServerNeed


class Choice(Protocol):
    """Of one worker. Returns the servers that it serves, in turn. told: needs of all servers; now: [s]"""

    def update(self, told: Mapping[str, ServerNeed], now: float) -> tuple[str, ...]: ...


class RoundRobin:
    """All servers in turn, as before there was a choice."""

    def __init__(self, names: Sequence[str]):
        self._names = tuple(names)

    def update(self, told: Mapping[str, ServerNeed], now: float) -> tuple[str, ...]:
        return self._names


class Fixed:
    """The same few servers for ever: a pool that shares nothing. seats: of the worker"""

    def __init__(self, names: Sequence[str], worker: int, seats: int):
        self._names = tuple(names[(worker * seats + k) % len(names)] for k in range(seats))

    def update(self, told: Mapping[str, ServerNeed], now: float) -> tuple[str, ...]:
        return self._names


class RandomSeats:
    """As many as there are servers for a worker, by lot, drawn again as often as the product may change one."""

    def __init__(self, names: Sequence[str], seats: int, seed: str):
        self._names, self._seats, self._random = names, seats, random.Random(seed)
        self._due = self._random.random() * REST
        self._taken = tuple(self._random.sample(names, seats))

    def update(self, told: Mapping[str, ServerNeed], now: float) -> tuple[str, ...]:
        if now >= self._due:
            self._due, self._taken = now + REST, tuple(self._random.sample(self._names, self._seats))
        return self._taken


POLICIES = ("need", "fixed", "random", "round robin")


def choice(policy: str, names: Sequence[str], worker: int, workers: int, seed: str) -> Choice:
    """The choice of one worker of a pool. names: of its servers; worker: number in it, of so many"""
    seats = max(1, -(-len(names) // workers))
    if policy == "need":
        return PoolChoice(seed)
    if policy == "fixed":
        return Fixed(names, worker, seats)
    return RandomSeats(names, seats, seed) if policy == "random" else RoundRobin(names)
