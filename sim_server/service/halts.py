# SPDX-License-Identifier: MIT
"""Answers commands once the loop stands still: `pause` and `stop` after the step under way, `step` after its last."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from protocol import messages_pb2 as pb
from sim_server.service.commands import Commands

HALT_TIMEOUT = 1.0  # s that the answer to `pause` waits for the end of the step under way, at most
STEPS_TIMEOUT = 60.0  # s that the answer to `step` or `stop` waits for the last step, at most
MAX_HALTS = 64  # answers that wait at a time

Reply = Callable[[pb.Reply], None]


@dataclass
class _Steps:
    """Single steps of a command. reply: None once it was answered"""

    until: float
    reply: Reply | None
    answer: pb.Reply
    count: int


class Halts:
    """Answers of `pause`, `stop` and `step` that wait. Single steps of several commands are made one after another."""

    def __init__(self, commands: Commands):
        self._commands = commands
        self._waiting: list[tuple[float, Reply, pb.Reply]] = []  # deadline, reply and answer
        self._steps: deque[_Steps] = deque()
        self._begun = False  # the loop was given the first of them

    def add(self, command: pb.Command, reply: Reply, answer: pb.Reply) -> bool:
        """Keeps an answer until it is due, or refuses single steps. False: it is due at once."""
        if answer.error:
            return False
        if command.verb == "pause":
            self._end_steps()
        full = len(self._waiting) + len(self._steps) >= MAX_HALTS
        if command.verb == "step" and full:
            reply(pb.Reply(error=f"the server is busy: {MAX_HALTS} commands wait for the end of steps"))
        elif command.verb == "step":
            self._steps.append(_Steps(time.monotonic() + STEPS_TIMEOUT, reply, answer, command.steps or 1))
        elif command.verb in ("pause", "stop") and not full:
            longest = HALT_TIMEOUT if command.verb == "pause" else STEPS_TIMEOUT
            self._waiting.append((time.monotonic() + longest, reply, answer))
        else:
            return False
        return True

    def _end_steps(self) -> None:
        """Has no single step made any more; those who asked are answered once the loop stands still."""
        until = time.monotonic() + HALT_TIMEOUT
        self._waiting += [(until, s.reply, s.answer) for s in self._steps if s.reply is not None]
        self._steps.clear()
        self._begun = False

    def answer(self, ended: bool = False) -> None:
        """Answers what is due, and begins the next single steps. ended: the loop makes no more steps."""
        commands, waiting = self._commands, []
        stands = commands.engine_halted
        for until, reply, answer in self._waiting:
            halted = stands or not commands.engine_paused  # or it goes on already
            late = time.monotonic() >= until
            if (halted and answer.status.state == "paused") or ended or late:
                if not (ended or (stands and answer.status.state == "paused")):
                    answer.status.state = "running"  # what it says is no more so, or not yet
                self._send(reply, answer)
            else:
                waiting.append((until, reply, answer))
        self._waiting = waiting
        self._answer_steps(ended)

    def _answer_steps(self, ended: bool) -> None:
        commands = self._commands
        while self._steps:
            first = self._steps[0]
            goes_on = ended or not commands.engine_paused
            if not self._begun and not goes_on:
                commands.make_steps(first.count)
                self._begun = True
            done = goes_on or commands.engine_halted
            if done:
                self._steps.popleft()
                self._begun = False
                if goes_on:
                    first.answer.status.state = "stopping" if commands.stopping else "running"
            for steps in (first, *self._steps):
                late = time.monotonic() >= steps.until  # they take longer than the answer may wait, and are made
                made = done and steps is first
                if steps.reply is not None and (late or made):
                    if not made:
                        steps.answer.status.state = "running"
                    self._send(steps.reply, steps.answer)
                    steps.reply = None
            if not done:
                return

    def _send(self, reply: Reply, answer: pb.Reply) -> None:
        self._commands.stamp(answer.status)
        reply(answer)
