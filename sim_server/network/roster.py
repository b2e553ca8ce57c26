# SPDX-License-Identifier: MIT
"""Which workers there are: they join by liveliness token and hello, stay by heartbeat, leave by token."""

from dataclasses import dataclass

from protocol.channels import CHANNELS, check_name, name_in
from protocol.check import check_header, check_strings, parse
from protocol.messages_pb2 import WorkerInfo
from protocol.refused import Refused

SILENCE = 2.0  # s without a heartbeat until a worker gets no more jobs
WORKERS = 256  # known at the same time


@dataclass
class Member:
    """A worker that said hello; seen: when it was heard of last [s, monotonic]."""

    info: WorkerInfo
    seen: float
    sequence: int

    def same_life(self, info: WorkerInfo) -> bool:
        """The hello comes from the process known by this name."""
        return (self.info.pid, self.info.host) == (info.pid, info.host)


class Roster:
    """Workers by name. Knows nothing of sockets: tokens and hellos are handed in."""

    def __init__(self, incarnation: int, silence: float = SILENCE):
        self._incarnation = incarnation
        self._silence = silence
        self._tokens: set[str] = set()
        self._members: dict[str, Member] = {}

    def token(self, name: str, alive: bool) -> bool:
        """A liveliness token came or went; True if a worker left by it."""
        if alive:
            if len(self._tokens) < WORKERS:
                self._tokens.add(name)
            return False
        self._tokens.discard(name)
        return self._members.pop(name, None) is not None

    def hello(self, key: object, data: bytes, now: float) -> tuple[str, bool]:
        """A hello or heartbeat: the worker's name, and whether a new life of it began; raises Refused."""
        info = parse(WorkerInfo, data, CHANNELS["worker"].limit)
        name = check_name(info.worker, "WorkerInfo.worker")
        if name != name_in("worker", key, "worker"):
            raise Refused(f"WorkerInfo.worker is {name!r}, its key is {key}", "worker")
        check_strings(info, 256)
        known = self._members.get(name)
        same = known is not None and known.same_life(info)
        header = check_header(
            info, incarnation=self._incarnation, after=known.sequence if known is not None and same else None
        )
        if known is not None and not same and now - known.seen < self._silence:
            raise Refused(
                f"WorkerInfo.worker is {name!r}, process {info.pid} on {info.host}; that name belongs to process "
                f"{known.info.pid} on {known.info.host}: give each worker a name of its own",
                "worker",
            )
        if known is None and len(self._members) >= WORKERS:
            raise Refused(f"WorkerInfo.worker is {name!r}, but {WORKERS} workers are known already", "worker")
        self._members[name] = Member(info, now, header.sequence)
        return name, not same

    def heard(self, name: str, now: float) -> None:
        """Anything else that a worker sends is a sign of life too."""
        if name in self._members:
            self._members[name].seen = now

    def fit(self, now: float, patience: dict[str, float]) -> list[str]:
        """Workers that may be given work: token and heartbeat are there.

        patience: until when [s, monotonic] a worker may be silent, since a long factorization holds its interpreter.
        """
        return [
            name
            for name, member in self._members.items()
            if name in self._tokens and now <= max(member.seen + self._silence, patience.get(name, 0.0))
        ]

    def info(self, name: str) -> WorkerInfo | None:
        """What a worker said last."""
        member = self._members.get(name)
        return member.info if member else None
