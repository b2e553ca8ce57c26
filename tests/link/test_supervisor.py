# SPDX-License-Identifier: MIT
"""Restarts of local workers, with processes and a clock of the test's own."""

import logging
from collections.abc import Sequence

import pytest

from sim_server.service.supervisor import BACK_OFF, BUDGET, PERIOD, Supervisor


class Process:
    """Runs until a test ends it."""

    def __init__(self, command: Sequence[str], pid: int):
        self.command, self.pid, self.returncode = list(command), pid, None

    def poll(self) -> int | None:
        return self.returncode


class World:
    """A supervisor of so many workers in a time that only a test moves."""

    def __init__(self, count: int = 1):
        self.now, self.started = 100.0, list[Process]()
        self.supervisor = Supervisor(count, "sim", ["tcp/h:1"], clock=lambda: self.now, start=self._start)  # type: ignore[arg-type]

    def _start(self, command: Sequence[str]) -> Process:
        self.started.append(Process(command, 1000 + len(self.started)))
        return self.started[-1]

    def die(self, code: int = -9) -> None:
        """The process started last ends."""
        self.started[-1].returncode = code
        self.supervisor.look()

    def pass_until_restart(self) -> float:
        """Time until another process is started."""
        begun, count = self.now, len(self.started)
        while len(self.started) == count:
            self.now += 0.05
            assert self.now - begun < 100
            self.supervisor.look()
        return self.now - begun


def test_each_has_a_name_and_the_servers_endpoint() -> None:
    world = World(2)
    names = [process.command[process.command.index("--name") + 1] for process in world.started]
    assert names == ["local-1", "local-2"]
    assert all("tcp/h:1" in process.command and "--exit-with-parent" in process.command for process in world.started)
    assert [(w.worker, w.state, w.restarts) for w in world.supervisor.report()] == [
        ("local-1", "running", 0),
        ("local-2", "running", 0),
    ]


def test_pauses_double_and_the_budget_ends_it(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    with caplog.at_level(logging.WARNING):
        for restart in range(BUDGET):
            world.die()
            assert world.supervisor.report()[0].state == "restarting"
            assert world.pass_until_restart() == pytest.approx(BACK_OFF * 2**restart, abs=0.06)
        world.die(1)
    (report,) = world.supervisor.report()
    assert (report.state, report.restarts, report.exit_code) == ("given up", BUDGET, 1)
    assert f"restart {BUDGET} of {BUDGET}" in caplog.text and "left alone" in caplog.text
    world.now += 10 * PERIOD
    world.supervisor.look()
    assert len(world.started) == 1 + BUDGET


def test_a_worker_that_lasts_gets_its_budget_back() -> None:
    world = World()
    for _ in range(3 * BUDGET):
        world.now += PERIOD
        world.die()
        assert world.pass_until_restart() == pytest.approx(BACK_OFF, abs=0.06)
    (report,) = world.supervisor.report()
    assert (report.state, report.restarts, report.pid) == ("running", 3 * BUDGET, world.started[-1].pid)
