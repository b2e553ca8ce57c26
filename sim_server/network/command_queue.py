# SPDX-License-Identifier: MIT
"""Commands between the network and the simulation: bounded, rated per client, the newest move of a grab alone."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable

from protocol.counters import Counters
from protocol.messages_pb2 import Command, Reply
from sim_server.network.rate_limiter import RateLimiter

WAITING = 64  # commands that may wait for the simulation
LATE = 1024  # moves that may wait for a token of their client, or for room
# For the other verbs there is as much room again, and a client may owe a burst: it can always let go, pause and stop.
RATED = ("push", "grab", "move")

ReplyFunction = Callable[[Reply], None]
PendingCommand = tuple[Command, ReplyFunction]


class CommandQueue:
    """`offer` from the network's thread, `take` from the service thread; neither waits.

    A command over its client's rate, or that finds no room, is refused and counted (commands_refused). A move is not:
    the newest one of each grab is kept until its turn comes and answers for those before it (moves_replaced), so that
    a hand that stops moving is where it stopped.
    """

    def __init__(
        self, counters: Counters, rates: RateLimiter | None = None, room: int = WAITING,
        clock: Callable[[], float] = time.monotonic,
    ):  # fmt: skip
        self._counters, self._room, self._clock = counters, room, clock
        self._rates = RateLimiter() if rates is None else rates
        self._lock = threading.Lock()
        self._queue: OrderedDict[Hashable, PendingCommand] = OrderedDict()  # in the order of their arrival
        self._late: OrderedDict[Hashable, PendingCommand] = OrderedDict()  # moves that wait for a token or for room

    def offer(self, command: Command, reply: ReplyFunction) -> None:
        """Takes a command in, or answers it with the reason why not."""
        with self._lock:
            replaced, refusal = self._place(command, reply)
        if replaced is not None:
            self._counters.add("moves_replaced")
            replaced(Reply())
        if refusal:
            self._counters.add("commands_refused")
            reply(Reply(error=refusal))

    def take(self) -> list[PendingCommand]:
        """All whose turn it is."""
        with self._lock:
            now = self._clock()
            for key in list(self._late):
                if len(self._queue) >= self._room:
                    break
                if self._rates.take(self._late[key][0].client, now):
                    self._queue[key] = self._late.pop(key)
            taken = list(self._queue.values())
            self._queue.clear()
        return taken

    def _place(self, command: Command, reply: ReplyFunction) -> tuple[ReplyFunction | None, str]:
        """Whom a newer move has replaced, and why the command is refused ("": it is not)."""
        move = command.verb == "move"
        key: Hashable = (command.client, command.interaction.id) if move else object()
        for waiting in (self._queue, self._late):
            if key in waiting:
                _, older = waiting[key]
                waiting[key] = command, reply
                return older, ""
        rated = command.verb in RATED
        debt, room = (0.0, self._room) if rated else (self._rates.burst, 2 * self._room)
        if len(self._queue) >= room:
            refusal = f"the server is busy: {room} commands wait already"
        elif not self._rates.take(command.client, self._clock(), debt):
            refusal = f"client {command.client!r} sends too much: at most {self._rates.rate:g} commands a second"
        else:
            self._queue[key] = command, reply
            return None, ""
        if move and len(self._late) < LATE:
            self._late[key] = command, reply
            return None, ""
        return None, refusal
