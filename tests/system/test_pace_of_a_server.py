# SPDX-License-Identifier: MIT
"""A server that does not keep pace with the clock says so on its terminal and in its status."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_server.network.link import ServerLink
from sim_server.service.service import Service
from sim_server.simulation import Simulation
from tests.ports import free_endpoint
from tests.system.server_process import Stage, beam, fresh, run, until

pytestmark = pytest.mark.system


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_a_server_that_cannot_keep_pace_says_so(stage: Stage, tmp_path: Path) -> None:
    server = stage.server(beam(tmp_path), "--set", "dt=1e-5")  # s; a step takes a hundred times as long
    told = "sim-server: cannot keep pace: a step takes "
    until(lambda: told in server.output(), "it says that it cannot keep pace")
    line = next(line for line in server.output().splitlines() if line.startswith(told))
    assert "ms (p50), dt is 0.01 ms; " in line
    assert "a larger dt" in line and "a coarser mesh" in line and "(--workers 1)" in line and "--free-run" in line
    assert f"(sim-client plan {tmp_path / 'beam.toml'} --budget-ms 0.01)" in line
    with stage.client() as client:
        until(lambda: fresh(client).pace.startswith("cannot keep pace: a step takes "), "the status says so")

    def shown() -> str:
        return run("clients", "status", "--connect", stage.endpoint).stdout  # judged anew after a stall of the machine

    until(lambda: "\ncannot keep pace: a step takes " in shown(), "the command shows it")


def test_a_free_run_has_no_clock_to_keep_pace_with(tmp_path: Path) -> None:
    simulation = Simulation.load(beam(tmp_path))
    with ServerLink(listen=[free_endpoint()]) as link:
        assert Service(simulation, link, realtime=False).pace is None
        assert Service(simulation, link, realtime=True).pace is not None
