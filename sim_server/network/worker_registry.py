# SPDX-License-Identifier: MIT
"""Which workers there are: they join by liveliness token and hello, stay by heartbeat, leave by token.

Anybody on the network may declare tokens and say hello. Both are bounded, and whoever says nothing holds no place
against one that does: of tokens without a hello the oldest is forgotten, of workers the one silent for longest.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from protocol.channels import CHANNELS, check_name, name_in
from protocol.check import check_header, check_strings, parse
from protocol.messages_pb2 import WorkerInfo
from protocol.refused import Refused

SILENCE = 2.0  # s without a heartbeat until a worker gets no more jobs
WORKERS = 256  # known at the same time
TOKENS = 1024  # of names that have said nothing yet
GAP = 1.0  # s between heartbeats, beyond which they do not tell what was between them
REPEATED = 5  # heartbeats, one second: sequence numbers further back are not repetitions


@dataclass
class RegisteredWorker:
    """A worker that said hello; seen: when it was heard of last [s, monotonic]."""

    info: WorkerInfo
    seen: float
    sequence: int
    token: bool
    idle: tuple[float, float] | None = None  # first and last of the heartbeats in a row that said so [s, monotonic]

    def same_life(self, info: WorkerInfo) -> bool:
        """The hello comes from the process known by this name."""
        return (self.info.pid, self.info.host) == (info.pid, info.host)


class WorkerRegistry:
    """Workers by name. Knows nothing of sockets: tokens and hellos are handed in."""

    def __init__(self, incarnation: int, silence: float = SILENCE):
        self._incarnation = incarnation
        self._silence = silence
        self._tokens: dict[str, None] = {}  # of names that have said nothing yet, oldest first
        self._members: dict[str, RegisteredWorker] = {}

    def token(self, name: str, alive: bool) -> bool:
        """A liveliness token came or went; True if a worker left by it. Raises Refused if another is forgotten."""
        if not alive:
            self._tokens.pop(name, None)
            return self._members.pop(name, None) is not None
        if name in self._members:
            self._members[name].token = True
            return False
        self._tokens[name] = None
        if len(self._tokens) > TOKENS:
            oldest = next(iter(self._tokens))
            del self._tokens[oldest]
            raise Refused(
                f"token of {name!r}: {TOKENS} others have said nothing yet; the oldest, {oldest!r}, is forgotten",
                "limit",
            )
        return False

    def hello(
        self, key: object, data: bytes, now: float, patience: Mapping[str, float] | None = None
    ) -> tuple[str, bool, str]:
        """A hello or heartbeat: the worker's name, whether a new life of it began, and who lost its place by it.

        patience: as of `fit`. Raises Refused.
        """
        info = parse(WorkerInfo, data, CHANNELS["worker"].limit)
        name = check_name(info.worker, "WorkerInfo.worker")
        if name != name_in("worker", key, "worker"):
            raise Refused(f"WorkerInfo.worker is {name!r}, its key is {key}", "worker")
        check_strings(info, 256)
        known = self._members.get(name)
        same = known is not None and known.same_life(info)
        header = check_header(info, incarnation=self._incarnation)
        if known is not None and same and known.sequence - REPEATED < header.sequence <= known.sequence:
            # Numbers far below are accepted: one forged heartbeat with a huge number must not shut the worker out.
            raise Refused(
                f"WorkerInfo.header.sequence is {header.sequence}; allowed: more than {known.sequence}", "sequence"
            )
        if known is not None and not same and now - known.seen < self._silence:
            raise Refused(
                f"WorkerInfo.worker is {name!r}, process {info.pid} on {info.host}; that name belongs to process "
                f"{known.info.pid} on {known.info.host}: give each worker a name of its own",
                "worker",
            )
        lost = self._make_room(name, now, patience or {}) if known is None else ""
        token = known.token if known is not None else name in self._tokens
        self._tokens.pop(name, None)
        idle = self._idle(known if same else None, info, now)
        self._members[name] = RegisteredWorker(info, now, header.sequence, token, idle)
        return name, not same, lost

    def _idle(self, known: RegisteredWorker | None, info: WorkerInfo, now: float) -> tuple[float, float] | None:
        if not info.idle:
            return None
        if known is None or known.idle is None or now - known.idle[1] > GAP:
            return now, now
        return known.idle[0], now

    def _make_room(self, name: str, now: float, patience: Mapping[str, float]) -> str:
        """Who has lost its place to a new worker, empty if nobody; raises Refused if all are at work."""
        if len(self._members) < WORKERS:
            return ""
        unfit = [other for other in self._members if not self._is_fit(other, now, patience)]
        if not unfit:
            raise Refused(f"WorkerInfo.worker is {name!r}, but {WORKERS} workers are known already", "limit")
        lost = min(unfit, key=lambda other: (self._members[other].token, self._members[other].seen))
        if self._members.pop(lost).token:
            self._tokens[lost] = None
        return lost

    def heard(self, name: str, now: float) -> None:
        """Anything else that a worker sends is a sign of life too."""
        if name in self._members:
            self._members[name].seen = now

    def fit(self, now: float, patience: Mapping[str, float]) -> list[str]:
        """Workers that may be given work: token and heartbeat are there.

        patience: until when [s, monotonic] a worker may be silent, since a long factorization holds its interpreter.
        """
        return [name for name in self._members if self._is_fit(name, now, patience)]

    def _is_fit(self, name: str, now: float, patience: Mapping[str, float]) -> bool:
        member = self._members[name]
        return member.token and now <= max(member.seen + self._silence, patience.get(name, 0.0))

    def idle(self, name: str) -> tuple[float, float] | None:
        """From when to when [s, monotonic] a worker has been saying that it has nothing in hand, if it says so now."""
        member = self._members.get(name)
        return member.idle if member else None

    def without_token(self, now: float) -> set[str]:
        """Workers that speak although their token is not known: it may have been forgotten, or lost in a flood."""
        return {
            name
            for name, member in self._members.items()
            if not member.token and now <= member.seen + self._silence
        }  # fmt: skip

    def info(self, name: str) -> WorkerInfo | None:
        """What a worker said last."""
        member = self._members.get(name)
        return member.info if member else None
