# SPDX-License-Identifier: MIT
"""Commands that come at once act one after another, with a service that the test drives."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.network.link import ServerLink
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.service.service import Service
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from tests.ports import free_endpoint
from tests.resets.state_scenes import made
from tests.system.server_process import beam, until

pytestmark = pytest.mark.system
GRAB = pb.Interaction(object="beam", kind="grab", at="tip", target=pb.Vector(x=1, z=4), stiffness=10, max_force=5)


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with ServerLink(listen=[free_endpoint()]) as link:
        service = Service(Simulation.load(beam(tmp_path, (1, 1, 2))), link)
        service.commands.release_absent = lambda clients: 0  # type: ignore[method-assign]
        yield service


def send(service: Service, monkeypatch: pytest.MonkeyPatch, *commands: pb.Command) -> list[pb.Reply]:
    """Has the service make a round with these commands; returns the replies, in the order in which they come."""
    replies: list[pb.Reply] = []
    monkeypatch.setattr(service.link, "commands", lambda: [(c, replies.append) for c in commands])
    service.round()
    monkeypatch.setattr(service.link, "commands", list)
    return replies


def setting(g: float) -> pb.Command:
    return pb.Command(verb="set", parameters=[pb.Parameter(key="gravity.g", value=f"[0, {g}, 0]")])


def test_what_was_to_be_set_is_set_before_what_comes_next(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    service.engine.loop.pause = 1
    step = pb.Command(verb="step", steps=3)
    replies = send(service, monkeypatch, setting(-1), setting(-2), step)
    assert len(replies) == 2 and service.engine.loop.single == 3, "the steps come after both"
    assert service.simulation.parameters.changed == {"effects.gravity.g": "[0.0, -2.0, 0.0]"}


def test_a_reset_releases_what_was_there_when_it_was_commanded(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    grab = pb.Command(verb="grab", client="anna", interaction=GRAB)
    first, second = send(service, monkeypatch, grab, pb.Command(verb="reset"), grab)
    service.engine.loop.held = service.engine.loop.hold  # the loop stands still
    service.round()
    assert service.simulation.touch is not None
    assert [a.id for a in service.simulation.touch.alive()] == [second.interaction.id] != [first.interaction.id]


def test_a_move_that_comes_after_a_reset_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    def moving(x: float) -> pb.Command:
        target = pb.ObstacleTarget(obstacle="tool", position=pb.Vector(x=x, y=0.4, z=0.1))
        return pb.Command(verb="move_obstacle", target=target)

    with ServerLink(listen=[free_endpoint()]) as link:
        service = Service(made("friction", preconditioner="block_jacobi"), link)
        contact = service.simulation.contact
        assert contact is not None
        reset = pb.Command(verb="reset")
        for commands, x in ((moving(0.3), reset), 0.1), ((reset, moving(0.2)), 0.2):
            send(service, monkeypatch, *commands)
            service.engine.loop.held = service.engine.loop.hold  # the loop stands still
            service.round()
            assert contact.targets["tool"][0] == x


def test_a_command_that_fails_between_steps_says_so_and_others_go_on(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(start: Start, name: str) -> None:
        raise RuntimeError("no room")

    monkeypatch.setattr(Start, "reset", broken)
    replies = send(service, monkeypatch, pb.Command(verb="reset"), pb.Command(verb="reset", object="beam"))
    service.engine.loop.held = service.engine.loop.hold
    service.round()
    assert [r.error for r in replies] == ["it failed: no room"] * 2 and not service.engine.loop.hold


def test_sets_that_wait_at_the_end_are_answered(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    replies = send(service, monkeypatch, *[setting(-1 - k) for k in range(3)])
    service.commands.stopping = True
    service.run()
    assert [bool(r.error) for r in replies] == [False, True, True]
    assert np.isfinite(service.simulation.fetch().x).all()


@pytest.mark.parametrize("first", [True, False])
def test_sets_and_resets_before_the_same_step_are_repeated_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: bool
) -> None:
    """first: one before the first step, which a server has begun with the parameters of the scene, and no reset."""
    reset, step, set_now = pb.Command(verb="reset"), pb.Command(verb="step", steps=4), setting(-2)
    waves = [[step], [setting(-3), *([] if first else [reset])], [setting(-4)], [step], [pb.Command(verb="stop")]]
    scene = beam(tmp_path, (1, 1, 2), '[integrator]\nscheme = "newmark"')
    given: list[list[pb.Command]] = [[set_now] if first else [reset, set_now]]
    replies: list[pb.Reply] = []
    with ServerLink(listen=[free_endpoint()]) as link, Recorder(tmp_path / "run.mcap") as recorder:
        service = Service(Simulation.load(scene), link, recorder, realtime=False)
        service.engine.loop.pause = 1
        monkeypatch.setattr(link, "commands", lambda: [(c, replies.append) for c in (given.pop(0) if given else [])])
        wanted = len(given[0])
        thread = threading.Thread(target=service.run)
        thread.start()
        for wave in waves:
            given.append(wave)
            wanted += len(wave)
            until(lambda wanted=wanted: len(replies) >= wanted, "all are answered")
        thread.join()
    assert not any(r.error for r in replies)
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.steps == 8 and Replay(recording).run().same
