# SPDX-License-Identifier: MIT
"""Others who answer in the name of a server: forged answers, garbage, silence, a second token."""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import zenoh

from clients.client import Client
from clients.errors import ClientError
from protocol import messages_pb2 as pb
from protocol.channels import commands, everything, key, server_in
from protocol.network.session import open_session
from tests.clients.fake_server import FakeServer
from tests.sample_run import header

pytestmark = pytest.mark.system

TIMEOUT = 60.0  # s: who waits for it a few times does not end within a test
EVIL = 0xDEADBEEF


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer() as started:
        yield started


def forged(query: zenoh.Query) -> None:
    """Any question is answered as by a server, with another incarnation."""
    head = header()
    head.incarnation = EVIL
    with query:
        if str(query.key_expr).startswith(commands(server_in(query.key_expr))):
            answer: pb.Reply | pb.Status = pb.Reply(header=head, error="EVIL says no")
        else:
            answer = pb.Status(header=head, scene="EVIL", state="running", step=666)
        query.reply(query.key_expr, answer.SerializeToString())


def garbage(query: zenoh.Query) -> None:
    with query:
        query.reply(query.key_expr, b"\xff" * 40)


class Silent:
    """Keeps each question without an answer."""

    def __init__(self) -> None:
        self.held: list[zenoh.Query] = []

    def __call__(self, query: zenoh.Query) -> None:
        self.held.append(query)


@contextmanager
def shadow(server: FakeServer, answer: Callable[[zenoh.Query], None], token: bool = False) -> Iterator[None]:
    """A process of somebody else's that answers on all keys of the server, with a token if asked."""
    with open_session("client", connect=[server.endpoint], shared_memory=False) as session:
        queryable = session.zenoh.declare_queryable(everything(server.name), answer)
        tokens = []
        if token:
            where = key("alive_server", server.name, incarnation=f"{EVIL:016x}")
            tokens.append(session.zenoh.liveliness().declare_token(where))
        list(session.zenoh.liveliness().get(key("alive_server", server.name), timeout=30.0))  # all that is known now
        yield
        del queryable, tokens


def used(server: FakeServer) -> None:
    """A client that comes now gets the server's answers, and does not wait for others."""
    with Client(connect=[server.endpoint], timeout=TIMEOUT) as client:
        for _ in range(3):
            found = client.status()
            assert (found.scene, found.step) == ("made-up.toml", 50)
        assert client.push("beam", at=(1, 0, 0), force=(0, -50, 0)).id == 11
        assert client.scene().name == "made-up.toml" and sorted(client.meshes()) == ["beam", "liver"]
        told: queue.SimpleQueue[pb.Reply | None] = queue.SimpleQueue()
        client.send("pause", answered=told.put)
        reply = told.get(timeout=TIMEOUT / 2)
        assert reply is not None and reply.error == ""


@pytest.mark.parametrize("kind", ["forged", "garbage", "silent"])
def test_a_shadow_changes_and_delays_nothing(server: FakeServer, kind: str) -> None:
    silent = Silent()
    answer = {"forged": forged, "garbage": garbage, "silent": silent}[kind]
    with shadow(server, answer):
        used(server)
        assert kind != "silent" or len(silent.held) > 3, "it was asked"
        for query in silent.held:
            query.drop()


def test_a_token_that_does_not_answer_is_passed_over(server: FakeServer) -> None:
    silent = Silent()
    with shadow(server, silent, token=True):
        used(server)
        for query in silent.held:
            query.drop()


def test_two_servers_of_one_name_are_both_named(server: FakeServer) -> None:
    with shadow(server, forged, token=True), pytest.raises(ClientError) as told:
        Client(connect=[server.endpoint], timeout=TIMEOUT)
    assert str(told.value).startswith(f"several servers are named 'sim' at {server.endpoint}: ")
    assert "0000000000000007" in str(told.value) and f"{EVIL:016x}" in str(told.value)


def test_who_was_there_first_is_kept(server: FakeServer) -> None:
    with Client(connect=[server.endpoint], timeout=TIMEOUT) as client, shadow(server, forged, token=True):
        assert client.status().scene == "made-up.toml"
        assert client.push("beam", at=(1, 0, 0), force=(0, -50, 0)).id == 11


def test_answers_without_a_token_are_no_server(server: FakeServer) -> None:
    with shadow(FakeServerOf(server, "other"), forged), pytest.raises(ClientError, match="has no liveliness token"):  # type: ignore[arg-type]
        Client("other", connect=[server.endpoint], timeout=0.5)


class FakeServerOf:
    """Another name at the endpoint of a server."""

    def __init__(self, server: FakeServer, name: str) -> None:
        self.endpoint, self.name = server.endpoint, name
