# SPDX-License-Identifier: MIT
"""What clients get of the server: queries, commands, published steps and states."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
from link_helpers import Driver, chain
from zenoh.handlers import RingChannel

from protocol.channels import FORMER_COMMAND, PROTOCOL, key
from protocol.messages_pb2 import (
    Command,
    Header,
    Interaction,
    ObjectStep,
    Reply,
    Scene,
    State,
    Status,
    Steps,
    Topology,
    Vector,
)
from protocol.network.session import open_session
from sim_server.network.command_queue import CAPACITY
from sim_server.network.link import ServerLink
from sim_server.network.queryables import OUTDATED
from tests.ports import free_endpoint

pytestmark = pytest.mark.system


def mine(header: Header, verb: str = "push", client: str = "me", **fields: Any) -> bytes:
    return Command(header=header, verb=verb, client=client, **fields).SerializeToString()


@pytest.fixture
def stage() -> Iterator[tuple[Driver, zenoh.Session]]:
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=False) as link,
        open_session("client", connect=[endpoint], shared_memory=False) as client,
    ):
        yield Driver(link), client.zenoh


def ask(session: zenoh.Session, selector: str, payload: bytes | None = None) -> zenoh.handlers.Handler:
    return session.get(selector, payload=payload, timeout=10.0)


def answers(handler: zenoh.handlers.Handler) -> list[bytes]:
    return [bytes(reply.ok.payload) for reply in handler if reply.ok is not None]


def test_late_joiners_get_scene_status_and_topology(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    assert answers(ask(session, key("topology"))) == []
    driver.link.set_scene(Scene(name="beam.toml", objects=["a", "b"]))
    driver.link.announce(chain(4, "a"))
    driver.link.announce(chain(5, "b", epoch=3))
    driver.link.publish_status(Status(scene="beam.toml", step=7, frames_dropped=3))
    scene = Scene.FromString(*answers(ask(session, key("scene"))))
    assert scene.name == "beam.toml" and scene.header.incarnation == driver.link.incarnation
    assert scene.header.protocol == PROTOCOL
    status = Status.FromString(*answers(ask(session, key("status"))))
    assert status.step == 7
    assert status.frames_dropped == 3, "what the log lost is not forgotten for what the network lost"
    topologies = [Topology.FromString(data) for data in answers(ask(session, key("topology")))]
    assert sorted((t.header.object, t.header.epoch, t.nodes) for t in topologies) == [("a", 1, 4), ("b", 3, 5)]
    only = [Topology.FromString(data).nodes for data in answers(ask(session, key("topology", object="b")))]
    assert only == [5]


def test_a_topology_is_sent_to_those_who_listen(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    listener = session.declare_subscriber(key("topology"), RingChannel(8))
    link = driver.link
    driver.until(lambda: link.announce(chain(6)) or listener.try_recv(), "a topology")


def test_commands_reach_the_simulation_and_replies_the_client(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    push = Interaction(object="beam", kind="push", point=Vector(x=1), force=Vector(y=-5), duration=0.1)
    command = Command(header=Header(protocol=PROTOCOL), client="me", verb="push", interaction=push)
    handler = ask(session, key("command", verb="push", client="me"), command.SerializeToString())
    received, reply = driver.until(lambda: driver.link.commands(), "the command")[0]
    assert received == command
    done = Interaction(id=4, object="beam", kind="push", nodes=3)
    reply(Reply(interaction=done))
    answer = Reply.FromString(*answers(handler))
    assert answer.error == "" and answer.interaction == done
    assert answer.header.incarnation == driver.link.incarnation


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (mine(Header()), f"Command.header.protocol is 0; allowed: {PROTOCOL}"),
        (b"", "a Command, '' of '', came under the key"),
        (b"\xff\xff\xff", "is not a valid message"),
        (b"\0" * 70_000, "Command has 70000 bytes; allowed: at most 65536"),
        (mine(Header(protocol=PROTOCOL, incarnation=5)), "header.incarnation is"),
        (mine(Header(protocol=PROTOCOL), object="x" * 5000), "Command.object has 5000"),
        (
            mine(Header(protocol=PROTOCOL), interaction=Interaction(force=Vector(z=math.nan))),
            "Vector.z is nan; allowed: finite",
        ),
        (
            mine(Header(protocol=PROTOCOL), verb="stop"),
            "'stop' of 'me', came under the key warpfactor/sim/command/push/me",
        ),
        (mine(Header(protocol=PROTOCOL), client="you"), "'push' of 'you', came under the key"),
    ],
)
def test_bad_commands_are_answered_with_what_is_wrong(
    stage: tuple[Driver, zenoh.Session], payload: bytes, text: str
) -> None:
    driver, session = stage
    answer = Reply.FromString(*answers(ask(session, key("command", verb="push", client="me"), payload)))
    assert text in answer.error
    assert driver.link.commands() == [] and driver.link.counters.refused == 1


def test_a_client_of_before_verbs_had_keys_is_told_so(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    answer = Reply.FromString(
        *answers(ask(session, f"warpfactor/sim/{FORMER_COMMAND}", mine(Header(protocol=PROTOCOL))))
    )
    assert answer.error == OUTDATED and answer.header.incarnation == driver.link.incarnation
    assert driver.link.commands() == [] and driver.link.counters.refusals["version"] == 1


@pytest.mark.parametrize("asked", ["command/*/*", "command/stop/*", "command/**", "**"])
def test_nobody_commands_under_more_than_one_key(stage: tuple[Driver, zenoh.Session], asked: str) -> None:
    driver, session = stage
    found = answers(ask(session, f"warpfactor/sim/{asked}", mine(Header(protocol=PROTOCOL), verb="stop")))
    assert not found or any("came under the key" in Reply.FromString(data).error for data in found if data)
    assert driver.link.commands() == []


def test_more_commands_than_can_wait_are_turned_away(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    command, where = mine(Header(protocol=PROTOCOL)), key("command", verb="push", client="me")
    waiting = [ask(session, where, command) for _ in range(CAPACITY)]
    surplus = Reply.FromString(*answers(ask(session, where, command)))
    assert "the server is busy" in surplus.error
    for _, reply in driver.until(lambda: driver.link.commands(), "the commands"):
        reply(Reply())
    assert all(Reply.FromString(*answers(handler)).error == "" for handler in waiting)


def test_steps_and_states_go_out_only_while_somebody_listens(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    link = driver.link
    assert not link.wants_steps() and not link.wants_state("beam")
    link.publish_steps(Steps())
    steps = session.declare_subscriber(key("steps"), RingChannel(64))
    states = session.declare_subscriber(key("state", object="beam"), RingChannel(1))
    driver.until(lambda: link.wants_steps() and link.wants_state("beam"), "the listeners")
    assert not link.wants_state("liver")
    link.publish_steps(Steps(steps=[ObjectStep(step=5, iterations=9)]))
    sample = driver.until(steps.try_recv, "steps")
    received = Steps.FromString(bytes(sample.payload))
    assert received.steps[0].iterations == 9 and received.header.sequence == 1  # the first one was for nobody
    x = np.arange(12.0)
    for step in range(1, 6):
        link.publish_state(State(header=Header(object="beam", epoch=1), step=step, nodes=4, x=x.tobytes()))

    def newest() -> bool:
        sample = states.try_recv()
        return sample is not None and State.FromString(bytes(sample.payload)).step == 5

    driver.until(newest, "the newest state")
    steps.undeclare()
    driver.until(lambda: not link.wants_steps(), "nobody to listen")


def test_clients_are_known_by_their_tokens(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    token = session.liveliness().declare_token(key("alive_client", client="viewer-1"))
    driver.until(lambda: driver.link.clients() == ["viewer-1"], "the client")
    driver.link.publish_status(Status())
    status = Status.FromString(*answers(ask(session, key("status"))))
    assert list(status.clients) == ["viewer-1"]
    token.undeclare()
    driver.until(lambda: driver.link.clients() == [], "the client to leave")


def test_the_server_is_known_by_its_token(stage: tuple[Driver, zenoh.Session]) -> None:
    driver, session = stage
    alive = [str(reply.ok.key_expr) for reply in session.liveliness().get(key("alive_server"), timeout=10.0)]
    assert alive == [key("alive_server", incarnation=f"{driver.link.incarnation:016x}")]
