# SPDX-License-Identifier: MIT
"""Answers of single steps and pauses that wait for the loop, with a loop of which the test plays the part."""

from collections.abc import Callable

import pytest

from protocol import messages_pb2 as pb
from sim_server.service import halts
from sim_server.service.commands import Commands
from sim_server.service.halts import MAX_HALTS, Halts
from tests.scenes import bar, simulation


class Server:
    """A paused server. answers: of its commands by number, in the order in which they come"""

    def __init__(self) -> None:
        sim = simulation(bar((2, 1, 1), fixed="X < 0.01"))
        self.commands = Commands(sim, lambda *_: None)
        self.halts, self.loop = Halts(self.commands), sim.engine.loop
        self.loop.pause, self.loop.deadline = 1, 0.0
        self.answers: dict[int, tuple[str, str]] = {}
        self._sent = 0

    def send(self, verb: str, steps: int = 0) -> None:
        number, self._sent = self._sent, self._sent + 1
        reply: Callable[[pb.Reply], None] = lambda r: self.answers.update({number: (r.status.state, r.error)})  # noqa: E731
        command = pb.Command(verb=verb, steps=steps)
        answer = self.commands.carry_out(command)
        if not self.halts.add(command, reply, answer):
            reply(answer)


@pytest.fixture
def server() -> Server:
    return Server()


def test_steps_that_are_too_many_to_wait_for_are_refused(server: Server) -> None:
    for _ in range(MAX_HALTS + 1):
        server.send("step")
    assert list(server.answers) == [MAX_HALTS] and "the server is busy" in server.answers[MAX_HALTS][1]


def test_steps_that_take_long_are_answered_and_made_before_the_next(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(halts, "STEPS_TIMEOUT", 0.0)
    server.send("step", 1000)
    monkeypatch.undo()
    server.send("step", 7)
    server.halts.answer()
    server.halts.answer()
    assert server.answers == {0: ("running", "")} and server.loop.single == 1000
    server.loop.single = 0  # the loop has made them
    server.halts.answer()
    assert server.loop.single == 7 and list(server.answers) == [0]
    server.loop.single = 0
    server.halts.answer()
    assert server.answers[1] == ("paused", "")


def test_a_pause_ends_single_steps_that_wait(server: Server) -> None:
    server.send("step", 1000)
    server.halts.answer()
    server.send("step", 5)
    server.send("pause")
    for _ in "xy":
        server.halts.answer()
    assert server.loop.single == 0 and server.answers == dict.fromkeys(range(3), ("paused", ""))
