# SPDX-License-Identifier: MIT
"""How many commands a client may send: a token bucket for each, in bounded memory."""

from dataclasses import dataclass

RATE = 200.0  # commands a second that each client may send for ever
BURST = 100.0  # ... and at once after a rest
CLIENTS = 256  # with a bucket of their own; those beyond share one


@dataclass
class TokenBucket:
    """Tokens that come in at `rate` a second, never more than `burst`; what is done takes one."""

    rate: float
    burst: float
    tokens: float
    filled: float  # s, when `tokens` was reckoned

    def take(self, now: float, debt: float = 0.0) -> bool:
        """Takes a token if there is one, or if no more than `debt` would be owed."""
        self._fill(now)
        if self.tokens - 1 < -debt:
            return False
        self.tokens -= 1
        return True

    def full(self, now: float) -> bool:
        """As good as new."""
        self._fill(now)
        return self.tokens >= self.burst

    def _fill(self, now: float) -> None:
        self.tokens = min(self.burst, self.tokens + self.rate * max(now - self.filled, 0.0))
        self.filled = max(now, self.filled)


class RateLimiter:
    """A bucket for each client by the name it gives.

    A full bucket is forgotten when room is needed, which changes nothing for its client. Who invents names gets no more
    than CLIENTS buckets in all; zenoh's access rules keep such clients out.
    """

    def __init__(self, rate: float = RATE, burst: float = BURST, clients: int = CLIENTS):
        self.rate, self.burst, self._clients = rate, burst, clients
        self._own: dict[str, TokenBucket] = {}
        self._shared: TokenBucket | None = None

    def take(self, client: str, now: float, debt: float = 0.0) -> bool:
        """Whether a command of this client may pass at `now` [s]."""
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
