# SPDX-License-Identifier: MIT
"""What a worker says reaches terminals and logs without its control characters."""

import logging

import pytest
from hand_worker import HandWorker
from link_helpers import Driver, chain
from server_process import run

from protocol.messages_pb2 import Status
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

EVIL = "\x1b]0;PWNED\x07\x1b[31m [/x] \r\nsim-server: all is well"
SHOWN = r"\x1b]0;PWNED\x07\x1b[31m [/x] \r\nsim-server: all is well"
BEAM = chain()


def test_a_worker_writes_no_control_characters_to_terminals_and_logs(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint()
    with (
        caplog.at_level(logging.INFO),
        ServerLink(listen=[endpoint], shared_memory=False, silence=60) as link,
        HandWorker(endpoint, link.incarnation) as hand,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello(library=EVIL, host=EVIL)
        driver.submit(BEAM, 1)
        answer, _ = hand.right_answer(hand.receive(), BEAM)
        answer.failure = EVIL
        hand.answer(answer)
        driver.until(lambda: driver.failures, "the failure")
        assert driver.failures[0][1].isprintable() and SHOWN in driver.failures[0][1]
        link.publish_status(Status(scene="scene"))
        done = run("clients", "status", "--connect", endpoint, COLUMNS="200")
        assert done.returncode == 0, done.stderr
        assert SHOWN in done.stdout and "\x1b" not in done.stdout and "\r" not in done.stdout
    assert SHOWN in caplog.text and "\x1b" not in caplog.text
