# SPDX-License-Identifier: MIT
"""The workers of a server: they join by liveliness token and hello, stay by heartbeat and leave by token.

Anybody on the network may declare tokens and send hellos, so both are bounded: of tokens without a hello the oldest is
dropped, of workers the one that is silent for longest.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from protocol.channels import CHANNELS, check_name, name_in
from protocol.messages_pb2 import WorkerInfo
from protocol.refused import Refused
from protocol.validate import check_header, check_strings, parse

SILENCE = 2.0  # s without a heartbeat until a worker gets no more jobs
WORKERS = 256  # most workers
TOKENS = 1024  # most tokens of names without a hello
HEARTBEAT_GAP = 1.0  # s; a longer gap between heartbeats ends a period of idleness
REPEATED = 5  # heartbeats, one second: sequence numbers further back are not taken for repetitions


@dataclass
class RegisteredWorker:
    """A worker that said hello. Times are monotonic [s].

    seen: time of its last message
    token: its liveliness token is there
    idle: times of the first and last of its heartbeats in a row that said that it has no job; None if the last did not
    """

    info: WorkerInfo
    seen: float
    sequence: int
    token: bool
    idle: tuple[float, float] | None = None

    def same_process(self, info: WorkerInfo) -> bool:
        """True if `info` comes from the process registered here."""
        return (self.info.pid, self.info.host) == (info.pid, info.host)


class WorkerRegistry:
    """Workers by name. Has no sockets: tokens and hellos are passed in."""

    def __init__(self, incarnation: int, silence: float = SILENCE):
        self._incarnation = incarnation
        self._silence = silence
        self._tokens: dict[str, None] = {}  # of names without a hello, oldest first
        self._workers: dict[str, RegisteredWorker] = {}

    def set_token(self, name: str, alive: bool) -> bool:
        """Notes that a liveliness token was declared or dropped; True if its worker left by that.

        Raises Refused if the token of another name is dropped for it.
        """
        if not alive:
            self._tokens.pop(name, None)
            return self._workers.pop(name, None) is not None
        if name in self._workers:
            self._workers[name].token = True
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

    def heartbeat(
        self, key: object, data: bytes, now: float, busy_until: Mapping[str, float] | None = None
    ) -> tuple[str, bool, str]:
        """Registers a hello or heartbeat. Returns (worker, its process is new, worker removed to make place for it).

        busy_until: as of `available`. Raises Refused.
        """
        info = parse(WorkerInfo, data, CHANNELS["worker"].limit)
        name = check_name(info.worker, "WorkerInfo.worker")
        if name != name_in("worker", key, "worker"):
            raise Refused(f"WorkerInfo.worker is {name!r}, its key is {key}", "worker")
        check_strings(info, 256)
        known = self._workers.get(name)
        same = known is not None and known.same_process(info)
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
        removed = self._remove_unavailable(name, now, busy_until or {}) if known is None else ""
        token = known.token if known is not None else name in self._tokens
        self._tokens.pop(name, None)
        idle = _idle_period(known if same else None, info, now)
        self._workers[name] = RegisteredWorker(info, now, header.sequence, token, idle)
        return name, not same, removed

    def _remove_unavailable(self, name: str, now: float, busy_until: Mapping[str, float]) -> str:
        """Removes a worker if there is no place for the new one `name`; returns its name, "" if none was removed.

        Raises Refused if all workers are available.
        """
        if len(self._workers) < WORKERS:
            return ""
        unavailable = [other for other in self._workers if not self._is_available(other, now, busy_until)]
        if not unavailable:
            raise Refused(f"WorkerInfo.worker is {name!r}, but {WORKERS} workers are known already", "limit")
        removed = min(unavailable, key=lambda other: (self._workers[other].token, self._workers[other].seen))
        if self._workers.pop(removed).token:
            self._tokens[removed] = None
        return removed

    @property
    def unclaimed_tokens(self) -> int:
        """Number of tokens of workers that have sent no heartbeat."""
        return len(self._tokens)

    def mark_seen(self, name: str, now: float) -> None:
        """Notes any other message of a worker, which is a sign of life too; it may be told of later than others."""
        if (worker := self._workers.get(name)) is not None:
            worker.seen = max(worker.seen, now)

    def available(self, now: float, busy_until: Mapping[str, float]) -> list[str]:
        """Workers that may be given jobs: their token is there and they are not silent.

        busy_until: time [s, monotonic] until which a worker may be silent, since a long factorization may block it.
        """
        return [name for name in self._workers if self._is_available(name, now, busy_until)]

    def _is_available(self, name: str, now: float, busy_until: Mapping[str, float]) -> bool:
        worker = self._workers[name]
        return (
            worker.token
            and not worker.info.leaving
            and now <= max(worker.seen + self._silence, busy_until.get(name, 0.0))
        )

    def idle_period(self, name: str) -> tuple[float, float] | None:
        """RegisteredWorker.idle of a worker."""
        worker = self._workers.get(name)
        return worker.idle if worker else None

    def without_token(self, now: float) -> set[str]:
        """Workers that send heartbeats while their token is unknown: it may have been dropped, or lost in a flood."""
        return {
            name
            for name, worker in self._workers.items()
            if not worker.token and now <= worker.seen + self._silence
        }  # fmt: skip

    def info(self, name: str) -> WorkerInfo | None:
        """The last heartbeat of a worker."""
        worker = self._workers.get(name)
        return worker.info if worker else None


def _idle_period(known: RegisteredWorker | None, info: WorkerInfo, now: float) -> tuple[float, float] | None:
    if not info.idle:
        return None
    if known is None or known.idle is None or now - known.idle[1] > HEARTBEAT_GAP:
        return now, now
    return known.idle[0], now
