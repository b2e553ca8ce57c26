# SPDX-License-Identifier: MIT
"""A second server that is to record to the file of a first one that runs."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ports import free_endpoint
from tests.system.server_process import Stage, beam, run, until

pytestmark = pytest.mark.system


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_it_is_refused_and_may_record_once_the_first_was_killed(stage: Stage, tmp_path: Path) -> None:
    log, scene = tmp_path / "run.mcap", beam(tmp_path)
    server = stage.server(scene, "--record", str(log), "--device", "cpu")
    with stage.client() as client:
        until(lambda: client.status().step > 3, "steps")
        second = (str(scene), "--listen", free_endpoint(), "--device", "cpu", "--free-run", "--steps", "3",
                  "--name", "second", "--record", str(log))  # fmt: skip
        refused = run("sim_server", *second)
        assert refused.returncode == 2 and "another server records to this file now" in refused.stderr, refused.stderr
        assert len(refused.stderr.splitlines()) == 1
        step = client.status(fresh=True).step
        until(lambda: client.status().step > step and not client.status().recording_failure, "the first to go on")
    server.kill()
    done = run("sim_server", *second)
    assert done.returncode == 0, done.stderr
    told = run("clients", "export", str(log), "--to", str(tmp_path / "out.csv"))
    assert told.returncode == 0 and not told.stderr, "the log of the second, whole"
