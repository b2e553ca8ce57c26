# SPDX-License-Identifier: MIT
"""The first step of a server in real time waits for its factors, tells so, and obeys commands meanwhile."""

import threading
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from clients.client import Client
from clients.log.reader import Log
from protocol.shared_memory import limits as shm_limits
from sim_server import cli
from sim_server.errors import InputError
from sim_server.network.link import ServerLink
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.service.service import Service
from sim_server.service.supervisor import Supervisor
from sim_server.simulation import Simulation
from sim_server.startup import set_up
from sim_server.startup.options import Options
from tests.ports import free_endpoint
from tests.system.hand_worker import HandWorker
from tests.system.link_helpers import PATIENCE
from tests.system.server_process import beam, fresh, run, until

pytestmark = pytest.mark.system


def test_a_client_sees_the_wait_and_may_pause_and_stop(tmp_path: Path) -> None:
    """With a worker that never answers."""
    endpoint, said = free_endpoint(), list[str]()
    with ServerLink(listen=[endpoint]) as link, HandWorker(endpoint, link.incarnation) as hand:
        service = Service(Simulation.load(beam(tmp_path, bar=(1, 1, 2))), link)
        service.say = said.append
        hand.hello()
        until(link.dispatch.workers, "the worker has joined")
        thread = threading.Thread(target=service.run)
        thread.start()
        try:
            with Client(connect=[endpoint], timeout=PATIENCE) as client:
                until(lambda: fresh(client).pace == "waiting for the first factor of beam", "the status says so")
                until(hand.has_job, "the matrix came")
                until(lambda: hand.hello() or said, "the terminal is told")
                assert (client.status().state, client.status().step) == ("running", 0)
                paused = client.pause().status
                assert (paused.state, paused.step, fresh(client).state) == ("paused", 0, "paused")
                assert client.stop().status.state == "stopping"
        finally:
            service.commands.stopping = True
            thread.join(PATIENCE)
    assert not thread.is_alive() and said == ["waiting for the first factor of beam"]


@pytest.mark.parametrize("options", ['build = "worker"', 'first_factor = "go"'])
def test_a_run_that_waited_is_repeated(tmp_path: Path, options: str) -> None:
    scene, log = beam(tmp_path, bar=(2, 2, 6), solver=options), tmp_path / "run.mcap"
    end = ("--steps", "20", "--listen", free_endpoint(), "--record", str(log), "--device", "cpu")
    done = run("sim_server", str(scene), "--workers", "1", *end)
    assert done.returncode == 0, done.stderr
    with Log(log) as opened:
        assert opened.scalars("beam")["factor_step"][0] == (-1 if "go" in options else 0)
    with Recording(log) as recording:
        assert Replay(recording).run().same


def test_a_run_that_does_not_wait_sends_the_matrix_of_its_very_first_step(tmp_path: Path) -> None:
    """Not that of the second one, which is due dt later."""
    endpoint = free_endpoint()
    scene = beam(tmp_path, bar=(1, 1, 2), solver='first_factor = "go"')
    with ServerLink(listen=[endpoint]) as link, HandWorker(endpoint, link.incarnation) as hand:
        service = Service(Simulation.load(scene), link, steps=5)
        hand.hello()
        until(link.dispatch.workers, "the worker has joined")
        thread = threading.Thread(target=service.run)
        thread.start()
        try:
            assert hand.receive().step == 0
        finally:
            service.commands.stopping = True
            thread.join(PATIENCE)
    assert not thread.is_alive()


@pytest.mark.skipif(bool(shm_limits.obstacle()), reason=f"no shared memory here: {shm_limits.obstacle()}")
def test_a_worker_is_ready_for_a_large_object_before_its_first_matrix(tmp_path: Path) -> None:
    """It has sent the pattern of the factors, so that their size is known, and the server finds out."""
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, ExitStack() as closing:
        service = Service(Simulation.load(beam(tmp_path, bar=(8, 8, 12))), link)
        known = link.dispatch.decoder.objects["beam"]
        assert not service.ready() and known.most_values("cholesky") == 0
        supervisor = Supervisor(1, "sim", [endpoint])
        closing.callback(supervisor.close)
        until(service.ready, "all is ready")
        assert known.most_values("cholesky") > 0 and link.counters.jobs == 0
        assert [pattern.nonzeros for pattern in known.patterns.values()] == [known.most_values("cholesky")]


@pytest.mark.parametrize(
    ("joins", "prepared", "begins"), [(2, 2.5, 2.5), (2, 99, 2 + cli.READY_TIMEOUT), (99, 99, cli.WORKER_TIMEOUT)]
)
def test_the_start_waits_until_all_is_ready_and_not_for_ever(
    monkeypatch: pytest.MonkeyPatch, joins: float, prepared: float, begins: float
) -> None:
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(cli.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(cli.time, "sleep", sleep)
    link = SimpleNamespace(dispatch=SimpleNamespace(workers=lambda: now[0] > joins), check_name=lambda: None)
    service: Any = SimpleNamespace(link=link, ready=lambda: now[0] > prepared)
    cli.wait_for_workers(service, None)
    assert now[0] == 0
    supervisor: Any = SimpleNamespace(check=lambda: None)
    cli.wait_for_workers(service, supervisor)
    assert now[0] == pytest.approx(begins, abs=0.05)


def test_workers_start_before_the_service_is_built_and_end_if_it_cannot_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []

    def start(closing: ExitStack, *_: Any) -> str:
        events.append("begin")
        closing.callback(events.append, "end")
        return "supervisor"

    def fail(*_: Any) -> None:
        events.append("service")
        raise InputError("spoiled")

    monkeypatch.setattr(set_up, "start_workers", start)
    monkeypatch.setattr(set_up, "make_service", fail)
    options = Options(
        beam(tmp_path, bar=(1, 1, 2)), [], "cpu", "sim", [free_endpoint()], None, True, None, None, True, 1, "cpu",
        None, True, None, None, False, None, [], None, None, None,
    )  # fmt: skip
    with pytest.raises(InputError, match="spoiled"), ExitStack() as closing:
        set_up.set_up(closing, options)
    assert events == ["begin", "service", "end"]
