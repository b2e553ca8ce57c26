# SPDX-License-Identifier: MIT
"""When jobs were sent, noted by the thread that sends them; what is made ready for the first one."""

import logging
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol.channels import PART_BYTES, PROTOCOL
from protocol.counters import Counters
from protocol.messages_pb2 import Header, Topology
from protocol.shared_memory.limits import POOL_LIMIT, SLOT_SHARE
from sim_server.network.bookkeeping import Bookkeeping
from sim_server.network.factor_decoder import FactorDecoder
from sim_server.network.job_sender import JobSender
from sim_server.network.leases import Leases
from sim_server.network.worker_registry import WorkerRegistry
from sim_server.network.worker_reliability import WorkerReliability
from sim_server.network.worker_timing import WorkerTiming
from sim_server.updates.factor_source import Job

SHARE = POOL_LIMIT // SLOT_SHARE  # bytes of the largest factor that comes in a slot


class Queue:
    """Sends once it is let."""

    def __init__(self) -> None:
        self.posted: list[Callable[[], None]] = []

    def post(self, send: Callable[[], None], name: object = None) -> bool:
        self.posted.append(send)
        return True

    def send(self) -> None:
        while self.posted:
            self.posted.pop()()


class OneWorker:
    """In place of network and choice: whatever is put is gone, and there is one worker, with room for all."""

    def put(self, *args: Any, **options: Any) -> None:
        return

    def open(self) -> list[str]:
        return ["w"]

    def candidates(self, idle: list[str], object: str) -> list[str]:
        return idle

    def choose(self, idle: list[str], object: str) -> str:
        return idle[0]


def topology(name: str) -> Topology:
    header = Header(protocol=PROTOCOL, incarnation=1, object=name, epoch=1)
    row_start, columns = (np.array(each, np.int32).tobytes() for each in ([0, 1], [0]))
    return Topology(header=header, nodes=1, row_start=row_start, columns=columns)


def test_a_job_has_left_once_the_network_took_it() -> None:
    """Not when it was handed over."""
    queue, one, now = Queue(), OneWorker(), [7.0]
    leases, decoder = Leases(None), FactorDecoder(1)
    book = Bookkeeping(WorkerRegistry(1, 1.0), leases, WorkerTiming(), WorkerReliability(), decoder, lambda: now[0])
    sender: Any = JobSender(one, "s", 1, None, queue, Counters(logging.getLogger(__name__)), book, one)  # type: ignore[arg-type]
    for name in ("a", "b"):
        book.announce(topology(name))
        assert sender.submit(Job(name, 1, 1, False, np.eye(3)[None]))
    assert [(job.sent_at, job.put_at) for job in leases.jobs] == [(7.0, float("inf"))] * 2
    now[0] = 9.0
    queue.send()
    assert [(job.sent_at, job.put_at) for job in leases.jobs] == [(7.0, 9.0)] * 2


@pytest.mark.parametrize(
    ("values", "bytes_"), [(1000, 4000), (30 << 20, 120 << 20), (SHARE // 4, SHARE), (SHARE // 4 + 1, PART_BYTES)]
)
def test_the_slot_of_a_factor_is_made_once_its_pattern_is_known(values: int, bytes_: int) -> None:
    """That for a part where it comes in parts."""
    prepared: list[int] = []
    pool = SimpleNamespace(limit=POOL_LIMIT, prepare=prepared.append)
    sender: Any = JobSender(*[None] * 2, 1, pool, *[None] * 4)  # type: ignore[arg-type]
    sender.prepare_for("o", SimpleNamespace(nonzeros=values), "w")
    assert prepared == [bytes_]


@pytest.mark.parametrize("shares", [True, False])
def test_device_memory_is_taken_only_for_a_worker_that_opens_it(shares: bool) -> None:
    """For the matrix and the factor of the first job."""
    prepared: list[list[int]] = []
    book = SimpleNamespace(decoder=SimpleNamespace(objects={"o": SimpleNamespace(blocks=1000)}))
    choice = SimpleNamespace(shares_device=lambda name: shares and name == "w")
    sender: Any = JobSender(*[None] * 2, 1, None, *[None] * 2, book, choice)  # type: ignore[arg-type]
    sender.device = SimpleNamespace(prepare=prepared.append)
    sender.prepare_for("o", SimpleNamespace(nonzeros=1 << 20), "w")
    sender.prepare_for("o", SimpleNamespace(nonzeros=100), "w")
    assert prepared == ([[72000, 4 << 20]] if shares else [])
