# SPDX-License-Identifier: MIT
"""The first step of a server in real time waits for its factors, tells so, and obeys commands meanwhile."""

import threading
from pathlib import Path

import pytest

from clients.client import Client
from clients.log.reader import Log
from sim_server.network.link import ServerLink
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.service.service import Service
from sim_server.simulation import Simulation
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
