# SPDX-License-Identifier: MIT
"""The server's own look at roles, behind the access rules."""

import logging

import pytest

from protocol.access.rights import Rights
from protocol.access.roles import VERBS
from protocol.counters import Counters
from protocol.messages_pb2 import Command, Reply
from protocol.refused import Refused
from sim_server.network.command_queue import CommandQueue
from sim_server.network.rate_limiter import BURST

RIGHTS = Rights({"eve": "viewer", "bob": "operator", "mill": "worker"})


@pytest.mark.parametrize(
    ("client", "verb", "text"),
    [
        ("eve.client-1", "stop", "stop is not for 'eve', a viewer; allowed: operator"),
        ("eve.client-1", "push", "push is not for 'eve', a viewer; allowed: participant or operator"),
        ("mill.w1", "status", "status is not for 'mill', a worker; allowed: viewer or participant or operator"),
        ("client-1", "status", "no certificate '' has a role here"),
        ("mallory.client-1", "status", "no certificate 'mallory' has a role here"),
    ],
)
def test_what_a_role_does_not_have_is_refused(client: str, verb: str, text: str) -> None:
    with pytest.raises(Refused) as told:
        RIGHTS.check(Command(client=client, verb=verb))
    assert (str(told.value), told.value.kind) == (text, "role")
    Rights(None).check(Command(client=client, verb=verb))


def test_a_client_is_told_what_it_may() -> None:
    assert RIGHTS.of("bob.client-1") == Reply(role="operator", verbs=VERBS)
    assert RIGHTS.of("mallory.c") == Reply() and RIGHTS.of("mill.w1") == Reply(role="worker")
    assert Rights(None).of("client-1") == Reply(verbs=VERBS)


def taken(queue: CommandQueue, client: str) -> bool:
    """Whether a push of the client is taken; the service takes it at once."""
    said: list[Reply] = []
    queue.put(Command(client=client, verb="push"), said.append)
    queue.take_all()
    return not said


def test_clients_of_a_certificate_share_its_limit() -> None:
    """Else a holder would get more by inventing names. Without certificates a name is all that is known."""
    certified, plain = (
        CommandQueue(Counters(logging.getLogger("test")), clock=lambda: 0.0, account=rights.account)
        for rights in (RIGHTS, Rights(None))
    )
    own = sum(taken(certified, f"eve.client-{k}") for k in range(3 * int(BURST)))
    assert own == BURST and taken(certified, "bob.client-1")
    assert all(taken(plain, f"eve.client-{k}") for k in range(250)), "before the buckets run out"
