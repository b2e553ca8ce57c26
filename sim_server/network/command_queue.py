# SPDX-License-Identifier: MIT
"""The queue of commands between the network and the simulation: bounded, with a rate limit for each client."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable

from protocol.counters import Counters
from protocol.messages_pb2 import Command, Reply
from sim_server.network.coalesce import moved_by
from sim_server.network.rate_limiter import MoveLimiter, RateLimiter

CAPACITY = 64  # commands with a rate limit that may wait; for the other verbs there is as much capacity again
MAX_DEFERRED = 1024  # moves that may wait for a token of their client or for capacity
LIMITED = (
    "push",
    "grab",
    "move",
    "move_obstacle",
    "cut",
    "set",
    "parameters",
    "reset",
    "add_worker",
    "kill_worker",
)  # verbs; with the others a client may owe a burst: it can always let go and stop

ReplyFunction = Callable[[Reply], None]
PendingCommand = tuple[Command, ReplyFunction]


class CommandQueue:
    """Takes commands from the network's threads (`put`) for the service thread (`take_all`); neither waits.

    A command over the rate limit of its client, or beyond the capacity, is refused and counted (commands_refused). A
    move is deferred instead: the newest move of each grab and obstacle waits until the limit admits it and answers for
    those before it (moves_replaced), so that what stops moving ends where it stopped. account: says whose rate limit a
    client has.
    """

    def __init__(
        self, counters: Counters, limiter: RateLimiter | None = None, capacity: int = CAPACITY,
        clock: Callable[[], float] = time.monotonic, moves: MoveLimiter | None = None,
        account: Callable[[str], str] = str,
    ):  # fmt: skip
        self._account = account
        self._counters, self._capacity, self._clock = counters, capacity, clock
        self._limiter = RateLimiter() if limiter is None else limiter
        self._moves = MoveLimiter(self._limiter) if moves is None else moves
        self._lock = threading.Lock()
        self._queue: OrderedDict[Hashable, PendingCommand] = OrderedDict()  # in the order of arrival
        self._deferred: OrderedDict[Hashable, PendingCommand] = OrderedDict()  # moves, in the order of arrival

    def put(self, command: Command, reply: ReplyFunction) -> None:
        """Queues a command, or answers it with the reason why it is refused."""
        with self._lock:
            replaced, refusal = self._place(command, reply)
        if replaced is not None:
            self._counters.add("moves_replaced")
            replaced(Reply())
        if refusal:
            self._counters.add("commands_refused")
            reply(Reply(error=refusal))

    def take_all(self) -> list[PendingCommand]:
        """Removes and returns all queued commands, and the deferred moves that the limits admit now."""
        with self._lock:
            now = self._clock()
            for key in list(self._deferred):
                if len(self._queue) >= self._capacity:
                    break
                if self._moves.allow(self._account(self._deferred[key][0].client), now):
                    self._queue[key] = self._deferred.pop(key)
            taken = list(self._queue.values())
            self._queue.clear()
        return taken

    def _place(self, command: Command, reply: ReplyFunction) -> tuple[ReplyFunction | None, str]:
        """Returns the reply function of the move that this one replaces, and the reason for a refusal ("": none)."""
        moved = moved_by(command)
        key: Hashable = object() if moved is None else moved
        for pending in (self._queue, self._deferred):
            if key in pending:
                _, older = pending[key]
                pending[key] = command, reply
                return older, ""
        limited = command.verb in LIMITED
        debt, capacity = (0.0, self._capacity) if limited else (self._limiter.burst, 2 * self._capacity)
        if len(self._queue) >= capacity:
            refusal = f"the server is busy: {capacity} commands wait already"
        elif not self._admits(command, moved is not None, debt):
            refusal = f"client {command.client!r} sends too much: at most {self._limiter.rate:g} commands a second"
        else:
            self._queue[key] = command, reply
            return None, ""
        if moved is not None and len(self._deferred) < MAX_DEFERRED:
            self._deferred[key] = command, reply
            return None, ""
        return None, refusal

    def _admits(self, command: Command, moves: bool, debt: float) -> bool:
        """Takes a token for the command; False if the client has none left."""
        now, client = self._clock(), self._account(command.client)
        return self._moves.allow(client, now) if moves else self._limiter.allow(client, now, debt)
