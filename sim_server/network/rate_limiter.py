# SPDX-License-Identifier: MIT
"""Limits how many commands each client may send: one token bucket per client, in bounded memory."""

from dataclasses import dataclass

RATE = 200.0  # commands per second that each client may send without end
BURST = 100.0  # commands that a client may send at once after a rest
CLIENTS = 256  # clients with a bucket of their own; all others share one
MOVES = 1000.0  # moves per second of each client beside its commands: one a step of 1 ms, for haptic devices
ALL_MOVES = 4000.0  # of all clients together


@dataclass
class TokenBucket:
    """Gains `rate` tokens per second up to `burst`; each command takes one."""

    rate: float
    burst: float
    tokens: float
    filled: float  # time [s] at which `tokens` was computed

    def take(self, now: float, debt: float = 0.0) -> bool:
        """Takes a token; False if that would leave fewer than -debt."""
        self._fill(now)
        if self.tokens - 1 < -debt:
            return False
        self.tokens -= 1
        return True

    def full(self, now: float) -> bool:
        """True if the bucket is in the state of a new one."""
        self._fill(now)
        return self.tokens >= self.burst

    def _fill(self, now: float) -> None:
        self.tokens = min(self.burst, self.tokens + self.rate * max(now - self.filled, 0.0))
        self.filled = max(now, self.filled)


class MoveLimiter:
    """Admits moves: each client's own MOVES, out of ALL_MOVES of all, and beyond these as many as its commands.

    So a few devices have each of their moves carried out, and a crowd has what it has without.
    """

    def __init__(
        self, commands: "RateLimiter", rate: float = MOVES, rate_of_all: float = ALL_MOVES, burst: float = BURST
    ):
        self._commands = commands
        self._own = RateLimiter(rate, burst)
        self._all = TokenBucket(rate_of_all, burst, burst, 0.0)

    def allow(self, client: str, now: float) -> bool:
        """Takes a token for a move of the client at time `now` [s]; False if it must wait."""
        if self._own.allow(client, now) and self._all.take(now):
            return True
        return self._commands.allow(client, now)


class RateLimiter:
    """Holds a token bucket for each client, by the name that the client gives.

    Full buckets are dropped when CLIENTS is reached, which changes nothing for their clients. A client that invents
    names gets no more than CLIENTS buckets in all; access rules of zenoh keep such clients out.
    """

    def __init__(self, rate: float = RATE, burst: float = BURST, clients: int = CLIENTS):
        self.rate, self.burst, self._clients = rate, burst, clients
        self._own: dict[str, TokenBucket] = {}
        self._shared: TokenBucket | None = None

    def allow(self, client: str, now: float, debt: float = 0.0) -> bool:
        """Takes a token of the client at time `now` [s]; False if its command must not pass. debt: as of `take`."""
        return self._bucket(client, now).take(now, debt)

    def _bucket(self, client: str, now: float) -> TokenBucket:
        if client not in self._own and len(self._own) >= self._clients:
            self._own = {name: bucket for name, bucket in self._own.items() if not bucket.full(now)}
        if client in self._own or len(self._own) < self._clients:
            return self._own.setdefault(client, self._new(now))
        self._shared = self._shared or self._new(now)
        return self._shared

    def _new(self, now: float) -> TokenBucket:
        return TokenBucket(self.rate, self.burst, self.burst, now)

    def __len__(self) -> int:
        return len(self._own)
