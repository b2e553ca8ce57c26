# SPDX-License-Identifier: MIT
"""Who a log says has made a factor."""

from typing import Any, cast

import pytest

from protocol.messages_pb2 import FactorUse, WorkerInfo
from sim_server.recording import replay_recorder
from sim_server.recording.replay_recorder import ReplayRecorder
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from tests.scenes import bar, simulation


class Server:
    """A driver and its recorder, with workers as the network knows them."""

    def __init__(self) -> None:
        sim = simulation(bar(cells=(2, 1, 1), size=(2, 1, 1), young=5e5, poisson=0.4, fixed="X < 0.01"))
        self.driver, self.workers = Driver(sim), dict[str, WorkerInfo]()
        self.written: list[FactorUse] = []
        inline = Inline({"bar": sim.system.body_pattern(0, len(sim.world.x))})
        sim.engine.assemble()
        inline.submit(Job("bar", 1, 0, True, sim.system.values, "float32"))
        (self.made,) = inline.poll()
        self.recorder = ReplayRecorder(self.driver, cast(Any, self), cast(Any, self))

    @property
    def dispatch(self) -> "Server":
        return self

    def worker_info(self, name: str) -> WorkerInfo | None:
        return self.workers.get(name)

    def factor(self, message: FactorUse, block: bool) -> None:
        self.written.append(message)

    def joins(self, name: str, library: str, threads: int = 2) -> None:
        self.workers[name] = WorkerInfo(worker=name, library=library, threads=threads)

    def adopts(self, worker: str, method: str = "") -> None:
        factor = type(self.made)(**vars(self.made) | {"worker": worker, "method": method})
        for observe in self.driver.on_adopt:
            observe(factor)

    def told(self) -> list[tuple[str, str, int]]:
        self.recorder.write(block=True)
        told = [(f.worker, f.library, f.threads) for f in self.written]
        self.written.clear()
        return told


@pytest.fixture
def server() -> Server:
    return Server()


def test_a_worker_that_is_started_again_with_another_library(server: Server) -> None:
    server.joins("w", "cholmod 3.0.14")
    server.adopts("w")
    server.joins("w", "supernodal", threads=1)
    server.adopts("w")
    assert server.told() == [("w", "cholmod 3.0.14", 2), ("w", "supernodal", 1)]


def test_a_worker_that_has_left_is_remembered(server: Server) -> None:
    server.joins("w", "cholmod 3.0.14")
    server.adopts("w")
    del server.workers["w"]
    server.adopts("w")
    server.adopts("unknown")
    assert server.told() == [("w", "cholmod 3.0.14", 2)] * 2 + [("unknown", "", 0)]


def test_as_many_are_remembered_as_there_may_be(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_recorder, "MAKERS", 2)
    for name in ("a", "b", "a", "c"):  # b is the one whose last factor is oldest
        server.joins(name, f"library of {name}")
        server.adopts(name)
    server.workers.clear()
    server.told()
    for name in "abc":
        server.adopts(name)
    assert [library for _, library, _ in server.told()] == ["library of a", "", "library of c"]


def test_incomplete_factors_are_made_by_native_code_and_own_ones_by_the_server(server: Server) -> None:
    server.joins("w", "cholmod 3.0.14")
    server.adopts("w", "incomplete_cholesky")
    server.adopts(server.driver.inline.WORKER)
    (first, own) = server.told()
    assert first == ("w", "native", 2)
    assert own == (server.driver.inline.WORKER, server.driver.inline.library("bar"), 1)
