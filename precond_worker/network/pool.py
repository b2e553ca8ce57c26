# SPDX-License-Identifier: MIT
"""A worker of a pool (--server '*'): finds the servers of an address, hears their needs, and says which to serve.

What servers tell is not trusted (trust.py). One that has sent no job yet is tried beside those that have, so that a
name without a server costs no work. Each try that comes to nothing makes the pause before the next ones longer.
"""

import math
import random
import threading
import time
from collections.abc import Callable, Collection, Mapping

import zenoh

from precond_worker.network.pool_choice import LEAST, PoolChoice, ServerNeed
from precond_worker.network.trust import Sent, Speakers, Trust
from protocol.channels import CHANNELS, key, name_in, server_in
from protocol.counters import Counters
from protocol.messages_pb2 import Need
from protocol.refused import Refused
from protocol.validate import check_header, parse

EVERY = "*"
MAX_SERVERS = 64  # served at a time without being named
MAX_KNOWN = 4096  # servers, and tokens of each
SILENT = 2.0  # s without a need after which a server is served as one that tells none
TRIED = 8  # servers at a time that have sent no job yet, while none has
TRIED_SHARE = 0.01  # part of this worker that such a server is told to have, beside others
FIRST_PAUSE, LONGEST_PAUSE = 10.0, 600.0  # s in which none is tried after one that sent no job
MOST_LOST = 64.0  # s of solving lost a second, by as many cores


class Pool:
    """The servers of one session. wake: set when one comes or goes.

    Methods but the callbacks of zenoh are for the main loop.
    """

    def __init__(
        self, session: zenoh.Session, name: str, counters: Counters, wake: threading.Event,
        clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        self._choice, self._counters, self._wake, self._clock = PoolChoice(name), counters, wake, clock
        self._random, self._trust, self._speakers = random.Random(name), Trust(), Speakers()
        self._kept: tuple[str, ...] = ()  # seats at servers that have sent jobs, while another is tried
        self._tried: tuple[str, ...] = ()  # beside the seats, while no server has sent a job
        self._pause, self._try_again = FIRST_PAUSE, float("-inf")
        self._lock = threading.Lock()
        self._tokens: dict[str, dict[int, None]] = {}  # incarnations by server
        self._since: dict[str, float] = {}  # when a server was found
        self._needs: dict[str, tuple[float, ServerNeed]] = {}
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
            message = read_need(bytes(sample.payload.to_bytes()), incarnations)
        except Refused as refusal:
            self._counters.refuse(refusal)
            return
        with self._lock:
            now = self._clock()
            self._speakers.hear(server, message.header.incarnation, message.header.sequence, now)
            self._needs[server] = now, ServerNeed(message.lost, message.workers)

    def wanted(self, sent: Mapping[str, Sent]) -> dict[str, float]:
        """Returns the servers to serve, and which part of this worker each has. sent: by those that are served"""
        now, trust = self._clock(), self._trust
        with self._lock:
            found = dict(self._since)
            needs = {
                name: need for name, (heard, need) in self._needs.items()
                if name in found and now - heard < 2 * SILENT and not self._speakers.contested(name, now)
            }  # fmt: skip
            self._speakers.keep(found)
        trust.keep(found)
        silent = [name for name, since in found.items() if name not in needs and now - since > SILENT]
        asking = {name for name, need in needs.items() if need.lost > 0}
        asking |= {name for name in silent if not trust.is_proven(name)}
        proven_before = {name for name in sent if trust.is_proven(name)}
        missed = trust.update(sent, asking, now)
        if any(trust.is_proven(name) for name in sent.keys() - proven_before):
            self._pause = FIRST_PAUSE
        elif missed - proven_before:
            self._try_again = now + self._pause
            self._pause = min(2 * self._pause, LONGEST_PAUSE)
        seats = self._seats(needs, sent, now)
        unproven = [name for name in silent if not trust.is_proven(name) and not trust.is_avoided(name, now)]
        served = [*seats, *(name for name in silent if trust.is_proven(name)), *unproven[:TRIED]][:MAX_SERVERS]
        proven = sum(map(trust.is_proven, served))
        if not proven:
            return {name: 1 / len(served) for name in served}
        return {name: 1 / proven if trust.is_proven(name) else TRIED_SHARE for name in served}

    def reject(self, server: str) -> None:
        """Avoids a server for a while, since it cannot be served."""
        self._trust.reject(server, self._clock())

    def _seats(self, needs: Mapping[str, ServerNeed], served: Collection[str], now: float) -> list[str]:
        """Returns the seats that the choice takes; while it tries a server, those that it had before, too.

        served: servers that this worker serves now, also without a seat, as those that told no need
        """
        trust = self._trust
        shown = {}
        needed = any(trust.is_proven(name) and need.lost > LEAST for name, need in needs.items())
        for name, need in needs.items():
            proven, avoided = trust.is_proven(name), trust.is_avoided(name, now)
            if proven:
                shown[name] = ServerNeed(0.0, need.workers) if avoided else need
            elif not avoided and (name in self._choice.seats or not needed or now >= self._try_again):
                shown[name] = need
        kept = tuple(name for name in self._kept if name in shown)
        if kept and not any(name in shown for name in self._choice.seats):
            self._choice.seats = kept
        seats = self._choice.update(shown, now)
        proven_seats = [name for name in shown if trust.is_proven(name)]
        if all(map(trust.is_proven, seats)):
            self._kept, self._tried = seats, ()
            return list(seats)
        if proven_seats:
            self._kept = kept or tuple(name for name in proven_seats if name in served)
            return list(dict.fromkeys((*seats, *self._kept)))
        others = [name for name in shown if shown[name].lost > LEAST and name not in seats]
        tried = [name for name in self._tried if name in others]
        fresh = [name for name in others if name not in tried]
        missing = max(min(TRIED - len(seats) - len(tried), len(fresh)), 0)
        self._tried = (*tried, *self._random.sample(fresh, missing))
        return [*seats, *self._tried]


def read_need(data: bytes, incarnations: set[int]) -> Need:
    """Reads a message. incarnations: of its server, that have a token. Raises Refused."""
    message = parse(Need, data, CHANNELS["need"].limit)
    check_header(message)
    if message.header.incarnation not in incarnations:
        raise Refused(f"Need.header.incarnation is {message.header.incarnation:#x}, which has no token", "incarnation")
    for field, most in (("lost", MOST_LOST), ("workers", 1e6)):
        value = getattr(message, field)
        if not (math.isfinite(value) and 0 <= value <= most):
            raise Refused(f"Need.{field} is {value}; allowed: 0 to {most:g}", "not_finite")
    return message
