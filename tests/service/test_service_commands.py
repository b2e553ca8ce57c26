# SPDX-License-Identifier: MIT
"""Commands on a simulation without a network."""

import pytest

from protocol import messages_pb2 as pb
from protocol.push_limits import LONGEST_PUSH
from sim_server.service.commands import Commands
from tests.scenes import bar, simulation


@pytest.fixture
def commands() -> Commands:
    sim = simulation(bar(young=1e5, fixed="X < 0.01", touch=True), dt=0.02)
    return Commands(sim, lambda interaction, time: None)


def push(commands: Commands, **fields: object) -> pb.Reply:
    given = {"object": "bar", "kind": "push", "at": "tip", "force": pb.Vector(y=1e-9), "duration": 0.1} | fields
    wanted = pb.Interaction(**given)  # type: ignore[arg-type]
    return commands.carry_out(pb.Command(client="anna", verb="push", interaction=wanted))


@pytest.mark.parametrize("duration", [LONGEST_PUSH * 1.001, 1e308])
def test_a_push_lasts_a_bounded_time(commands: Commands, duration: float) -> None:
    assert push(commands, duration=duration).error == f"duration = {duration:g} s: a push lasts at most 3600 s"
    assert commands.interactions() == []
    assert push(commands, duration=LONGEST_PUSH).error == ""


def test_a_named_point_is_answered_with_where_it_is(commands: Commands) -> None:
    taken = push(commands).interaction
    assert taken.point.x == 2.0 and taken.nodes == 1
    assert "no point 'nose'; known: tip" in push(commands, at="nose").error
    assert "no object 'liver'" in push(commands, object="liver").error
    grab = pb.Interaction(object="bar", kind="grab", at="top", stiffness=10, max_force=5)
    held = commands.carry_out(pb.Command(client="anna", verb="grab", interaction=grab)).interaction
    assert held.point == held.target and held.point.y == 1.0
    grab.target.CopyFrom(pb.Vector(x=3))
    held = commands.carry_out(pb.Command(client="anna", verb="grab", interaction=grab)).interaction
    assert held.target == pb.Vector(x=3) and held.point.y == 1.0


def test_pause_resume_and_stop_say_what_happened(commands: Commands) -> None:
    commands.simulation.engine.run(3)

    def done(verb: str) -> tuple[str, int, bool]:
        reply = commands.carry_out(pb.Command(client="anna", verb=verb))
        assert reply.error == "" and reply.status.time == pytest.approx(0.06)
        return reply.status.state, reply.status.step, reply.unchanged

    assert [done(verb) for verb in ("resume", "pause", "pause", "resume", "stop")] == [
        ("running", 3, True), ("paused", 3, False), ("paused", 3, True), ("running", 3, False), ("stopping", 3, False),
    ]  # fmt: skip


def test_only_a_paused_server_takes_single_steps_and_only_so_many(commands: Commands) -> None:
    step = pb.Command(client="anna", verb="step", steps=2)
    assert "is not paused" in commands.carry_out(step).error
    commands.carry_out(pb.Command(client="anna", verb="pause"))
    assert commands.carry_out(step).status.state == "paused"
    assert commands.carry_out(pb.Command(client="anna", verb="step", steps=1_000_001)).error == (
        "steps = 1000001: at most 1000000"
    )


def test_an_error_that_no_check_foresees_is_told_and_the_run_goes_on(
    commands: Commands, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*arguments: object) -> None:
        raise KeyError("nose")

    monkeypatch.setattr(commands.simulation.touch, "push", broken)
    assert push(commands).error == "it failed: KeyError: 'nose'"
    for _ in range(9):
        push(commands)
    (told,) = caplog.records
    assert (
        "command push of anna: KeyError: 'nose' (test_service_commands.py:" in told.getMessage() and not told.exc_info
    )
    assert commands.counters.refusals == {"unexpected": 10}
    monkeypatch.undo()
    assert push(commands).error == ""
