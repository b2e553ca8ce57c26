# SPDX-License-Identifier: MIT
"""Which servers of a pool are believed, by what they do: they send jobs. No clock, no I/O.

Anybody on a network without certificates can declare the token of a server and say that it needs workers, under a name
of its own or that of a real one. A server is *tried* until it has sent a job, without leaving those that have. One that
asks for workers and sends no job is avoided for a time that doubles each time.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

NO_JOB = 10.0  # s without a job from a server that asks for workers
AVOIDED = 60.0  # s for which it is avoided the first time
LONGEST_AVOIDED = 3600.0  # s
CONTESTED = 60.0  # s for which the needs of a server are not believed once somebody else tells them, too
MOST_LIVES = 16  # of a server that are remembered; more, one soon after another, are a sign of the same
CONFLICTS = 3  # messages with numbers out of order, by which that is seen


class Sent(NamedTuple):
    """What a server has sent since it is served. factors: made of its jobs; waiting: there is a job not yet begun"""

    factors: int
    waiting: bool


@dataclass
class _Record:
    proven: bool = False  # it has sent a job that a factor could be made of
    factors: int = 0
    last_job: float | None = None  # or since when it is served [s]; None: it is not
    misses: int = 0  # times that it asked and sent none, in a row
    avoided_until: float = float("-inf")


class Trust:
    """What is known of the servers of a pool, by name."""

    def __init__(self) -> None:
        self._records: dict[str, _Record] = {}

    def is_proven(self, server: str) -> bool:
        """True if a factor was made for it while it was served."""
        return server in self._records and self._records[server].proven

    def is_avoided(self, server: str, now: float) -> bool:
        """True if it asked for workers and sent no job."""
        return server in self._records and now < self._records[server].avoided_until

    def keep(self, servers: Collection[str]) -> None:
        """Forgets all others: a server that comes back begins anew."""
        self._records = {name: record for name, record in self._records.items() if name in servers}

    def update(self, sent: Mapping[str, Sent], asking: Collection[str], now: float) -> set[str]:
        """Takes in what was sent; returns the servers that are avoided from now on.

        sent: by servers that are served. asking: those that say that they need workers
        """
        for name, record in self._records.items():
            if name not in sent:
                record.last_job = None
        found = set()
        for name, (factors, waiting) in sent.items():
            record = self._records.setdefault(name, _Record())
            if record.last_job is None:
                record.last_job, record.factors = now, 0
            if factors > record.factors:
                record.proven, record.misses, record.factors = True, 0, factors
            elif not waiting and name in asking:
                if now - record.last_job > NO_JOB and now >= record.avoided_until:
                    self._miss(record, now)
                    found.add(name)
                continue
            record.last_job = now
        return found

    def reject(self, server: str, now: float) -> None:
        """Avoids a server that cannot be served, as one that never sent a job."""
        record = self._records.setdefault(server, _Record())
        record.proven = False
        self._miss(record, now)

    def _miss(self, record: _Record, now: float) -> None:
        record.avoided_until = now + min(AVOIDED * 2.0**record.misses, LONGEST_AVOIDED)
        record.misses = min(record.misses + 1, 30)


class Speakers:
    """Finds out that more than one tells the needs of a server: numbers of messages, or its lives, go back and forth.

    Whoever forges messages in the name of a server that tells its own cannot avoid that.
    """

    def __init__(self) -> None:
        self._last: dict[str, dict[int, int]] = {}  # by server and incarnation, the newest incarnation last
        self._conflicts: dict[str, tuple[int, float]] = {}  # how many, time of the last one

    def hear(self, server: str, incarnation: int, sequence: int, now: float) -> None:
        """Takes in the number of a message about the need of a server."""
        lives = self._last.setdefault(server, {})
        if incarnation in lives:
            odd = sequence <= lives[incarnation] or incarnation != next(reversed(lives))
        elif odd := len(lives) >= MOST_LIVES:
            lives.pop(next(iter(lives)))
        lives[incarnation] = sequence
        if odd:
            count, last = self._conflicts.get(server, (0, now))
            self._conflicts[server] = (count if now - last < CONTESTED else 0) + 1, now

    def contested(self, server: str, now: float) -> bool:
        """True if somebody else speaks in the name of a server, or did so a while ago."""
        count, last = self._conflicts.get(server, (0, now))
        return count >= CONFLICTS and now - last < CONTESTED

    def keep(self, servers: Collection[str]) -> None:
        """Forgets all others."""
        for table in (self._last, self._conflicts):
            for name in [name for name in table if name not in servers]:
                del table[name]  # type: ignore[attr-defined]
