# SPDX-License-Identifier: MIT
"""The client library against the network side of a server."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.watch import places
from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL
from tests.clients.fake_server import FakeServer
from tests.sample_run import REST, object_step, positions

pytestmark = pytest.mark.system


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer() as started:
        yield started


@pytest.fixture
def client(server: FakeServer) -> Iterator[Client]:
    with Client(connect=[server.endpoint]) as connected:
        yield connected


def eventually(check: Callable[[], bool]) -> bool:
    """Polls for as long as a busy machine may need."""
    deadline = time.monotonic() + 30
    while not check():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def test_status_scene_and_meshes(client: Client) -> None:
    assert client.status().state == "running" and client.status().objects[1].object == "liver"
    assert list(client.scene().objects) == ["beam", "liver"]
    meshes = client.meshes()
    assert sorted(meshes) == ["beam", "liver"]
    np.testing.assert_array_equal(meshes["beam"].rest, REST)


def test_a_status_without_positions_is_asked_for_again(server: FakeServer, client: Client) -> None:
    """That of each second has none and may come between a command and its query; without any a line says so."""
    told, without = server.status, [1, 0]  # from behind: in the reply to the command, in that to the query

    def status() -> pb.Status:
        found = told()
        if without and without.pop():
            for each in found.objects:
                each.ClearField("low")
        return found

    server.status = status  # type: ignore[method-assign]
    assert client.status(fresh=True).objects[0].HasField("low")
    assert [command.verb for command in server.commands] == ["status", "status"]
    without.extend([1] * 10)
    found = client.status(fresh=True)
    assert not found.objects[0].HasField("low") and "ask again" in str(places(found))


def test_push_says_what_it_means(server: FakeServer, client: Client) -> None:
    taken = client.push("beam", at=(1, 0, 0), force=(0, -50, 0), radius=0.5, duration=0.2)
    assert taken.id == 11 and taken.nodes == 4
    sent = server.commands[-1]
    assert sent.verb == "push" and sent.client == sent.interaction.client == client.id
    assert sent.interaction == pb.Interaction(
        client=client.id,
        object="beam",
        kind="push",
        point=pb.Vector(x=1),
        force=pb.Vector(y=-50),
        radius=0.5,
        duration=0.2,
    )


def test_grab_moves_and_releases(server: FakeServer, client: Client) -> None:
    with client.grab("beam", at=(1, 0, 0), stiffness=200, max_force=30) as held:
        held.move((1, 2, 3))
    held.release()
    assert [command.verb for command in server.commands] == ["grab", "move", "release"]
    first, move, release = (command.interaction for command in server.commands)
    assert first.target == first.point == pb.Vector(x=1) and first.stiffness == 200 and first.max_force == 30
    assert move.id == release.id == 11 and move.target == pb.Vector(x=1, y=2, z=3)


def test_grab_is_released_after_an_error(server: FakeServer, client: Client) -> None:
    with pytest.raises(ZeroDivisionError), client.grab("beam", at=(1, 0, 0)):
        raise ZeroDivisionError
    assert server.commands[-1].verb == "release"


def test_pause_resume_stop(server: FakeServer, client: Client) -> None:
    client.pause()
    assert client.status().state == "paused"
    client.resume()
    assert client.status().state == "running"
    client.stop()
    assert server.commands[-1].verb == "stop"


def test_newest_frame_of_each_object(server: FakeServer, client: Client) -> None:
    """A reader that was away gets one frame per object, the last, and none of the others push it out."""
    states = client.states()
    assert states.newest() == []

    def arrived() -> bool:
        server.publish(1)
        return len(states.newest()) == 2

    assert eventually(arrived)
    for step in range(2, 30):
        server.publish(step)
    seen: dict[str, list[int]] = {"beam": [], "liver": []}

    def last_seen() -> bool:
        for frame in states.newest():
            seen[frame.object].append(frame.step)
            np.testing.assert_array_equal(frame.x, positions(frame.step))
        return all(steps[-1:] == [29] for steps in seen.values())

    assert eventually(last_seen)
    assert all(steps == sorted(steps) for steps in seen.values())


def test_steps_in_order(server: FakeServer, client: Client) -> None:
    steps = client.steps()
    received: list[pb.ObjectStep] = []

    def arrived() -> bool:
        server.publish(1)
        return bool(steps.new())

    assert eventually(arrived)
    for step in range(100, 110):
        server.publish(step)

    def all_there() -> bool:
        received.extend(step for step in steps.new() if step.step >= 100)
        return len(received) == 20

    assert eventually(all_there)
    assert [s for s in received if s.header.object == "beam"] == [object_step("beam", k) for k in range(100, 110)]


def test_garbage_is_left_out(server: FakeServer, client: Client, caplog: pytest.LogCaptureFixture) -> None:
    states, steps = client.states(), client.steps()

    def complained() -> bool:
        server.publish_garbage()
        assert states.newest() == [] and steps.new() == []
        return "frames were left out" in caplog.text and "steps were left out" in caplog.text

    assert eventually(complained)


def test_client_is_seen_while_it_lives(server: FakeServer) -> None:
    with Client(connect=[server.endpoint]) as client:
        assert eventually(lambda: server.clients() == [client.id])
    assert eventually(lambda: server.clients() == [])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"at": (1, math.nan, 0)}, "--at 1 nan 0: allowed are three finite numbers"),
        ({"at": (1, 2)}, "--at 1 2: allowed are three finite numbers"),
        ({"force": (math.inf, 0, 0)}, "--force inf 0 0"),
        ({"radius": -1.0}, "--radius -1.0: allowed is a finite number of at least 0"),
        ({"duration": 0.0}, "--duration 0.0: allowed is a finite number above 0"),
        ({"object": "spleen"}, "push: no object 'spleen'; there is beam, liver"),
    ],
)
def test_bad_push(client: Client, options: dict, said: str) -> None:
    with pytest.raises(BadInput) as caught:
        client.push(**({"object": "beam", "at": (0, 0, 0), "force": (1, 0, 0)} | options))
    assert said in str(caught.value)


def test_no_server_there() -> None:
    with pytest.raises(ClientError, match=r"no server 'sim' at tcp/127\.0\.0\.1:9; is it running\?"):
        Client(connect=["tcp/127.0.0.1:9"], timeout=0.3)


def test_server_of_another_name(server: FakeServer) -> None:
    with pytest.raises(ClientError, match=f"no server 'other' at {server.endpoint}; there is 'sim'"):
        Client("other", connect=[server.endpoint])


def test_server_that_hangs(server: FakeServer, client: Client) -> None:
    with Client(connect=[server.endpoint], timeout=0.3) as hasty:
        server.silent = True
        with pytest.raises(ClientError, match="did not answer in time"):
            hasty.status()


def test_server_of_another_version(server: FakeServer) -> None:
    server.protocol += 1
    with pytest.raises(
        ClientError, match=rf"does not understand: Status\.header\.protocol is {PROTOCOL + 1}; allowed: {PROTOCOL}"
    ):
        Client(connect=[server.endpoint])


def test_bad_names() -> None:
    with pytest.raises(BadInput, match="server name is 'a/b'"):
        Client("a/b")
    with pytest.raises(BadInput, match="endpoint 'localhost' cannot be used"):
        Client(connect=["localhost"])
