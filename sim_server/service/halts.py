# SPDX-License-Identifier: MIT
"""Answers commands once the loop stands still: `pause` and `stop` after the step under way, `step` after its last."""

import time
from collections import deque
from collections.abc import Callable

from protocol import messages_pb2 as pb
from sim_server.service.commands import Commands

HALT_TIMEOUT = 1.0  # s that the answer to `pause` or `stop` waits for the end of the step under way, at most
STEPS_TIMEOUT = 60.0  # s that the answer to `step` waits for its last step, at most
MAX_HALTS = 64  # answers that wait at a time

Reply = Callable[[pb.Reply], None]


class Halts:
    """Answers of `pause`, `stop` and `step` that wait. Single steps of several commands are made one after another."""

    def __init__(self, commands: Commands):
        self._commands = commands
        self._waiting: list[tuple[float, Reply, pb.Reply]] = []  # deadline, reply and answer
        self._steps: deque[tuple[float, Reply, pb.Reply, int]] = deque()  # likewise, and number of steps
        self._begun = False  # the loop was given the first of them

    def add(self, command: pb.Command, reply: Reply, answer: pb.Reply) -> bool:
        """Keeps an answer until it is due. False: it is due at once."""
        if answer.error or len(self._waiting) + len(self._steps) >= MAX_HALTS:
            return False
        if command.verb == "step":
            self._steps.append((time.monotonic() + STEPS_TIMEOUT, reply, answer, command.steps or 1))
        elif command.verb in ("pause", "stop"):
            self._waiting.append((time.monotonic() + HALT_TIMEOUT, reply, answer))
        else:
            return False
        return True

    def answer(self, ended: bool = False) -> None:
        """Answers what is due, and begins the next single steps. ended: the loop makes no more steps."""
        commands, waiting = self._commands, []
        stands = commands.engine_halted
        for until, reply, answer in self._waiting:
            halted = stands or not commands.engine_paused  # or it goes on already
            if (halted and answer.status.state == "paused") or ended or time.monotonic() >= until:
                self._send(reply, answer)
            else:
                waiting.append((until, reply, answer))
        self._waiting = waiting
        self._answer_steps(ended)

    def _answer_steps(self, ended: bool) -> None:
        commands = self._commands
        while self._steps:
            until, reply, answer, steps = self._steps[0]
            goes_on = ended or not commands.engine_paused
            if not self._begun and not goes_on:
                commands.make_steps(steps)
                self._begun = True
            if not (goes_on or commands.engine_halted or time.monotonic() >= until):
                return
            if not goes_on and not commands.engine_halted:
                answer.status.state = "running"  # they take longer than the answer may wait
            elif goes_on:
                answer.status.state = "stopping" if commands.stopping else "running"
            self._send(reply, answer)
            self._steps.popleft()
            self._begun = False

    def _send(self, reply: Reply, answer: pb.Reply) -> None:
        self._commands.stamp(answer.status)
        reply(answer)
