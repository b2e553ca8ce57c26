# SPDX-License-Identifier: MIT
"""A worker of a pool (--server '*'): finds the servers of an address, hears their needs, and says which to serve.

What servers tell is not trusted: it is bounded, and one that says that it needs a worker and sends it no job is taken
for one without a need for a while.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping

import zenoh

from precond_worker.pool_choice import PoolChoice, ServerNeed
from protocol.channels import CHANNELS, key, name_in, server_in
from protocol.counters import Counters
from protocol.messages_pb2 import Need
from protocol.refused import Refused
from protocol.validate import check_header, parse

EVERY = "*"
MAX_SERVERS = 64  # served at a time without being named
MAX_KNOWN = 4096  # servers, and tokens of each
SILENT = 2.0  # s without a need after which a server is served as one of a version that tells none
NO_JOB = 10.0  # s without a job from a server that says that it needs a worker
DISTRUST = 60.0  # s for which such a server has no need
MOST_LOST = 64.0  # s of solving lost a second, by as many cores


class Pool:
    """The servers of one session. wake: set when one comes or goes. jobs: returns the jobs that a server has sent

    Methods but the callbacks of zenoh are for the main loop.
    """

    def __init__(
        self, session: zenoh.Session, name: str, counters: Counters, wake: threading.Event,
        clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        self._choice, self._counters, self._wake, self._clock = PoolChoice(name), counters, wake, clock
        self._lock = threading.Lock()
        self._tokens: dict[str, dict[int, None]] = {}  # incarnations by server
        self._since: dict[str, float] = {}  # when a server was found
        self._needs: dict[str, tuple[float, ServerNeed]] = {}
        self._jobs: dict[str, tuple[float, int]] = {}  # of servers that are served: when their number last grew
        self._distrusted: dict[str, float] = {}  # until when
        self._needs_heard = session.declare_subscriber(key("need", EVERY), self._need)
        self._tokens_seen = session.liveliness().declare_subscriber(
            key("alive_server", EVERY), self._token, history=True
        )

    def _token(self, sample: zenoh.Sample) -> None:
        try:
            server = server_in(sample.key_expr)
            incarnation = int(name_in("alive_server", sample.key_expr, "incarnation"), 16)
        except ValueError as error:
            self._counters.refuse(error if isinstance(error, Refused) else Refused(f"{sample.key_expr}: {error}"))
            return
        with self._lock:
            there = self._tokens.setdefault(server, {})
            if sample.kind != zenoh.SampleKind.PUT:
                there.pop(incarnation, None)
            elif len(there) < MAX_KNOWN and len(self._tokens) <= MAX_KNOWN:
                there[incarnation] = None
                self._since.setdefault(server, self._clock())
            if not there:
                for table in (self._tokens, self._since, self._needs):
                    table.pop(server, None)  # type: ignore[attr-defined]
        self._wake.set()

    def _need(self, sample: zenoh.Sample) -> None:
        try:
            server = server_in(sample.key_expr)
            with self._lock:
                incarnations = set(self._tokens.get(server, ()))
            need = read_need(bytes(sample.payload.to_bytes()), incarnations)
        except Refused as refusal:
            self._counters.refuse(refusal)
            return
        with self._lock:
            self._needs[server] = self._clock(), need

    def wanted(self, jobs: Mapping[str, int]) -> dict[str, float]:
        """Returns the servers to serve, and which part of this worker each has. jobs: of those served, sent so far"""
        now = self._clock()
        with self._lock:
            found, needs = dict(self._since), dict(self._needs)
        told = {name: need for name, (heard, need) in needs.items() if name in found and now - heard < 2 * SILENT}
        seats = self._choice.update({name: self._trusted(name, need, jobs, now) for name, need in told.items()}, now)
        silent = [name for name, since in found.items() if name not in told and now - since > SILENT]
        wanted = [*seats, *silent[: MAX_SERVERS - len(seats)]]
        return {name: 1 / len(wanted) for name in wanted}

    def _trusted(self, name: str, need: ServerNeed, jobs: Mapping[str, int], now: float) -> ServerNeed:
        """Returns the need of a server, none if it has sent no job though it says that it needs a worker."""
        if name in jobs:
            since, number = self._jobs.get(name, (now, -1))
            if jobs[name] != number:
                since = now
            self._jobs[name] = since, jobs[name]
            if now - since > NO_JOB and need.lost > 0:
                self._distrusted[name] = now + DISTRUST
        else:
            self._jobs.pop(name, None)
        if self._distrusted.get(name, 0.0) > now:
            return ServerNeed(0.0, need.workers)
        return need


def read_need(data: bytes, incarnations: set[int]) -> ServerNeed:
    """Reads a message. incarnations: of its server, that have a token. Raises Refused."""
    message = parse(Need, data, CHANNELS["need"].limit)
    check_header(message)
    if message.header.incarnation not in incarnations:
        raise Refused(f"Need.header.incarnation is {message.header.incarnation:#x}, which has no token", "incarnation")
    for field, most in (("lost", MOST_LOST), ("workers", 1e6)):
        value = getattr(message, field)
        if not (math.isfinite(value) and 0 <= value <= most):
            raise Refused(f"Need.{field} is {value}; allowed: 0 to {most:g}", "not_finite")
    return ServerNeed(message.lost, message.workers)
