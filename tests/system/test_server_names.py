# SPDX-License-Identifier: MIT
"""Of servers that are linked with one another there is one of a name: whoever comes second leaves."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from link_helpers import PATIENCE, Driver, chain, light_worker
from server_process import Process, Stage, beam, fresh, until

from protocol.channels import key
from protocol.network.session import open_session
from sim_server.errors import NameTaken
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

TAKEN = "another sim-server called 'sim' answers at {}; --name gives this one a name of its own"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_a_second_server_of_one_name_is_refused_and_the_first_keeps_its_worker(stage: Stage, tmp_path: Path) -> None:
    scene, log = beam(tmp_path), tmp_path / "run.mcap"
    stage.server(scene, "--record", str(log))
    stage.worker()
    with stage.client() as client:
        until(lambda: client.status().workers, "the worker")
        written = log.stat().st_size
        second = stage.start(
            "sim_server", str(scene), "--listen", free_endpoint(), "--connect", stage.endpoint, "--record", str(log)
        )
        assert second.wait() == 2
        assert TAKEN.format(stage.endpoint) in second.output() and "Traceback" not in second.output()
        assert log.stat().st_size >= written, "the log of the first was left alone"
        used = fresh(client).objects[0].factors_used
        until(lambda: fresh(client).objects[0].factors_used > used, "more factors")
        assert [worker.worker for worker in client.status().workers] == ["w1"]


def test_of_two_that_start_at_the_same_instant_one_leaves(stage: Stage, tmp_path: Path) -> None:
    scene, meeting = beam(tmp_path), free_endpoint()
    with open_session("server", listen=[meeting], shared_memory=False):
        pair = [
            stage.start("sim_server", str(scene), "--listen", free_endpoint(), "--connect", meeting) for _ in range(2)
        ]
        until(lambda: any(server.process.poll() is not None for server in pair), "one to leave")
        left, stays = sorted(pair, key=lambda server: server.process.poll() is None)
        assert left.wait() == 2 and TAKEN.format(meeting) in left.output()
        time.sleep(1.0)
        assert stays.process.poll() is None, "the other one stays"


def test_a_server_that_was_killed_comes_up_again_under_its_name(stage: Stage, tmp_path: Path) -> None:
    scene, meeting = beam(tmp_path), free_endpoint()
    stage.endpoint = meeting
    with open_session("server", listen=[meeting], shared_memory=False):

        def start() -> Process:
            return stage.start("sim_server", str(scene), "--listen", free_endpoint(), "--connect", meeting)

        first = start()
        with stage.client() as client:
            pid = client.status().pid
        first.kill()
        start()
        with stage.client() as client:
            until(lambda: client.status().pid != pid, "the new life")


def test_two_that_meet_when_a_link_is_made_late_keep_one_of_them() -> None:
    """The one that has been there for longer stays, whatever their numbers: here it waits for the other's endpoint."""
    own, late = free_endpoint(), free_endpoint()
    ahead = 0.0

    def clock() -> float:
        return time.monotonic() + ahead

    with ServerLink(listen=[own], connect=[late], shared_memory=False, clock=clock) as first:
        first.announce(chain())
        first.check_name()
        ahead = 60.0  # as if it had been there for a minute
        with light_worker(own):
            Driver(first).factor(chain(), 1)
            with ServerLink(listen=[late], shared_memory=False) as second, pytest.raises(NameTaken):
                end = time.monotonic() + PATIENCE
                while time.monotonic() < end:
                    first.check_name()
                    second.check_name()
                    time.sleep(0.01)
            Driver(first).factor(chain(), 2)


def test_the_token_of_a_server_that_does_not_answer_takes_no_name() -> None:
    meeting = free_endpoint()
    with open_session("server", listen=[meeting], shared_memory=False) as router:
        _token = router.zenoh.liveliness().declare_token(key("alive_server", incarnation="00000000deadbeef"))
        with ServerLink(listen=[free_endpoint()], connect=[meeting], shared_memory=False) as link:
            end = time.monotonic() + 1.5
            while time.monotonic() < end:
                link.check_name()
                time.sleep(0.01)
