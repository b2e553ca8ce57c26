# SPDX-License-Identifier: MIT
"""Attacks on a pool without certificates, by real processes: whoever says that it needs workers and sends them no jobs
takes none away."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from protocol.channels import PROTOCOL, key, server_in
from protocol.messages_pb2 import Header, Need
from protocol.network.session import open_session
from tests.system.server_process import Stage, beam, fresh, until

pytestmark = pytest.mark.system
FAKES = [f"fake{k}" for k in range(6)]


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    one = Stage(tmp_path)
    yield one
    one.close()


class Forger:
    """Tells needs, five times a second, of servers that are none, and in the name of the real one.

    joined, left: fakes that worker "w" came to, and those that it left again
    """

    def __init__(self, endpoint: str, incarnation: int):
        self._session = open_session("client", connect=[endpoint], shared_memory=False)
        zs = self._session.zenoh
        alive = [zs.liveliness().declare_token(key("alive_server", name, incarnation=f"{7:016x}")) for name in FAKES]
        taken = [zs.liveliness().declare_token(key("alive_worker", name, worker="w")) for name in FAKES[:2]]
        self.joined, self.left = set[str](), set[str]()
        heard = zs.liveliness().declare_subscriber(key("alive_worker", "*", worker="w"), self._heard)
        self._kept = (alive, taken, heard)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._tell, args=(incarnation,))
        self._thread.start()

    def _heard(self, sample: zenoh.Sample) -> None:
        server = server_in(sample.key_expr)
        if server in FAKES[2:]:
            (self.joined if sample.kind == zenoh.SampleKind.PUT else self.left).add(server)

    def _tell(self, incarnation: int) -> None:
        count = 0
        while not self._over.wait(0.2):
            count += 1
            for name, life, lost in (*((fake, 7, 64.0) for fake in FAKES), ("sim", incarnation, 0.0)):
                header = Header(protocol=PROTOCOL, incarnation=life, sequence=count)
                self._session.zenoh.put(key("need", name), Need(header=header, lost=lost).SerializeToString())

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self._session.close()


def test_forged_needs_and_names_take_no_worker_of_a_pool_away(stage: Stage, tmp_path: Path) -> None:
    stage.server(beam(tmp_path))
    worker = stage.worker("w", "--server", "*")
    with stage.client() as client:

        def used() -> int:
            return fresh(client).objects[0].last.factor_step

        until(lambda: used() > 0, "a factor is used")
        forger = Forger(stage.endpoint, client.status().header.incarnation)
        try:

            def left_a_fake() -> bool:
                assert [w.worker for w in fresh(client).workers] == ["w"], worker.output()
                return bool(forger.left)

            until(left_a_fake, "it tries a fake and leaves it")
            assert forger.joined
            last = used()
            until(lambda: used() > last, "factors come")
            left_a_fake()
        finally:
            forger.close()
    assert worker.end() == 0
