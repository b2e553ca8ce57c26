# SPDX-License-Identifier: MIT
"""Who subscribes to everything and stops reading holds up neither jobs nor factors nor answers."""

import os
import signal
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from hand_worker import HandWorker
from link_helpers import Driver, chain, matrix, process

from protocol.channels import key
from protocol.messages_pb2 import Factor, Status
from protocol.network.session import open_session
from protocol.shared_memory import limits as shm_limits
from sim_server.network.link import ServerLink
from sim_server.updates.factor_source import Job
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

PROGRAM = Path(__file__).parent / "deaf_subscriber.py"
LARGE = chain(6000)  # 1.3 MB of matrix
ROUNDS = 30  # more than a link holds


def stopped(endpoint: str, count: int, closing: ExitStack) -> None:
    """Subscribers of everything that do not read any more."""
    children = [closing.enter_context(process(str(PROGRAM), endpoint)) for _ in range(count)]
    for child in children:
        assert child.stdout is not None and child.stdout.readline() == "listens\n"
        os.kill(child.pid, signal.SIGSTOP)


@pytest.mark.parametrize(("count", "shared"), [(1, True), (5, True), (5, False)])
def test_jobs_factors_heartbeats_and_answers_pass(count: int, shared: bool) -> None:
    if shared and shm_limits.obstacle():
        pytest.skip(f"no shared memory here: {shm_limits.obstacle()}")
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=shared, silence=60) as link,
        HandWorker(endpoint, link.incarnation, shared_memory=shared) as hand,
        open_session("client", connect=[endpoint], shared_memory=False) as client,
        ExitStack() as closing,
    ):
        driver = Driver(link)
        link.announce(LARGE)
        link.publish_status(Status(step=1))
        hand.hello()
        driver.until(link.dispatch.ready, "the worker")
        job = Job("beam", 1, 1, True, matrix(LARGE))
        bulk = np.zeros(1 << 17).tobytes()

        def one_round() -> None:
            driver.until(lambda: link.dispatch.ready() and link.dispatch.submit(job), "a worker that is ready")
            asked, seen = hand.receive(), len(driver.failures)
            header = hand.header("beam", 1)
            hand.answer(Factor(header=header, worker="hand", job=asked.header.sequence, failure="none"), bulk)
            driver.until(lambda: len(driver.failures) > seen, "the answer")
            assert [reply.ok is not None for reply in client.zenoh.get(key("status"), timeout=10.0)] == [True]

        one_round()
        stopped(endpoint, count, closing)
        for done in range(1, ROUNDS + 1):
            one_round()
            hand.hello(jobs=done)
            driver.until(lambda done=done: link.dispatch.workers()[0].jobs == done, "the heartbeat")
        assert link.counters.leases_over == 0
        assert all(reason.endswith("failed: none") for _, reason in driver.failures)
