# SPDX-License-Identifier: MIT
"""Answers of single steps and pauses that wait for the loop, with a loop of which the test plays the part."""

from collections.abc import Callable

import pytest

from protocol import messages_pb2 as pb
from sim_server.service import halts
from sim_server.service.commands import Commands
from sim_server.service.halts import MAX_HALTS, Halts
from tests.scenes import bar, simulation

LongStep = Callable[[str, str], None]


class Server:
    """A paused server. answers: of its commands by number, in the order in which they come"""

    def __init__(self) -> None:
        sim = simulation(bar((2, 1, 1), fixed="X < 0.01"))
        self.commands = Commands(sim, lambda *_: None)
        self.halts, self.loop = Halts(self.commands), sim.engine.loop
        self.answers: dict[int, tuple[str, str]] = {}
        self._sent = 0
        self.send("pause")
        self.stand_still()
        self.answers.clear()
        self._sent = 0

    def stand_still(self) -> None:
        """What the loop does once the step under way has ended, or the last one of single steps."""
        self.loop.single, self.loop.halted = 0, self.loop.pause
        self.halts.answer()

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


@pytest.fixture
def in_a_long_step(server: Server, monkeypatch: pytest.MonkeyPatch) -> LongStep:
    """Sends a verb to a server that runs; a bound of halts.py, by its name, is over before the step."""

    def send(verb: str, bound: str) -> None:
        server.send("resume")
        with monkeypatch.context() as patch:
            patch.setattr(halts, bound, 0.0)
            server.send(verb)
            server.halts.answer()

    return send


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


def test_a_pause_is_answered_by_its_own_standing_still(server: Server) -> None:
    """The loop still stands in the first pause when the second one comes: it may be about to make a step."""
    server.send("resume")
    server.send("pause")
    server.halts.answer()
    assert list(server.answers) == [0], "the loop has not seen the second one"
    server.stand_still()
    assert server.answers[1] == ("paused", "")


def test_a_pause_of_a_long_step_says_that_it_runs(server: Server, in_a_long_step: LongStep) -> None:
    in_a_long_step("pause", "HALT_TIMEOUT")
    assert server.answers[1] == ("running", "")
    server.send("pause")
    server.halts.answer()
    assert 2 not in server.answers, "the client asks again"
    server.stand_still()
    assert server.answers[2] == ("paused", "")


def test_a_stop_tells_the_last_step_however_long_it_takes(server: Server, in_a_long_step: LongStep) -> None:
    in_a_long_step("stop", "HALT_TIMEOUT")
    assert 1 not in server.answers, "it would tell a step that is not the last"
    server.halts.answer(ended=True)
    assert server.answers[1] == ("stopping", "")


def test_a_stop_in_a_step_without_end_says_that_it_runs(server: Server, in_a_long_step: LongStep) -> None:
    in_a_long_step("stop", "STEPS_TIMEOUT")
    assert server.answers[1] == ("running", "")
