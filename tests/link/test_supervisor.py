# SPDX-License-Identifier: MIT
"""Restarts of local workers, with processes and a clock of the test's own."""

import logging
from collections.abc import Sequence

import pytest

from protocol import messages_pb2 as pb
from sim_server.service.commands import Commands
from sim_server.service.supervisor import BACK_OFF, MAX_RESTARTS, MAX_WORKERS, RESTART_PERIOD, Supervisor
from tests.scenes import bar, simulation


class Process:
    """Runs until a test ends it."""

    def __init__(self, command: Sequence[str], pid: int):
        self.command, self.pid, self.returncode = list(command), pid, None

    def poll(self) -> int | None:
        return self.returncode

    def kill(self) -> None:
        self.returncode = -9


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
        self.supervisor.check()

    def pass_until_restart(self) -> float:
        """Time until another process is started."""
        begun, count = self.now, len(self.started)
        while len(self.started) == count:
            self.now += 0.05
            assert self.now - begun < 100
            self.supervisor.check()
        return self.now - begun


def test_each_has_a_name_and_the_servers_endpoint() -> None:
    world = World(2)
    names = [process.command[process.command.index("--name") + 1] for process in world.started]
    assert names == ["local-1", "local-2"]
    assert all("tcp/h:1" in process.command and "--exit-with-parent" in process.command for process in world.started)
    assert [(w.worker, w.state, w.restarts) for w in world.supervisor.local_workers()] == [
        ("local-1", "running", 0),
        ("local-2", "running", 0),
    ]


def test_pauses_double_and_the_budget_ends_it(caplog: pytest.LogCaptureFixture) -> None:
    world = World()
    with caplog.at_level(logging.WARNING):
        for restart in range(MAX_RESTARTS):
            world.die()
            assert world.supervisor.local_workers()[0].state == "restarting"
            assert world.pass_until_restart() == pytest.approx(BACK_OFF * 2**restart, abs=0.06)
        world.die(1)
    (report,) = world.supervisor.local_workers()
    assert (report.state, report.restarts, report.exit_code) == ("given up", MAX_RESTARTS, 1)
    assert f"restart {MAX_RESTARTS} of {MAX_RESTARTS}" in caplog.text and "left alone" in caplog.text
    world.now += 10 * RESTART_PERIOD
    world.supervisor.check()
    assert len(world.started) == 1 + MAX_RESTARTS


def test_a_worker_that_lasts_gets_its_budget_back() -> None:
    world = World()
    for _ in range(3 * MAX_RESTARTS):
        world.now += RESTART_PERIOD
        world.die()
        assert world.pass_until_restart() == pytest.approx(BACK_OFF, abs=0.06)
    (report,) = world.supervisor.local_workers()
    assert (report.state, report.restarts, report.pid) == ("running", 3 * MAX_RESTARTS, world.started[-1].pid)


def test_clients_add_and_kill_workers() -> None:
    world = World()
    commands = Commands(simulation(bar(young=1e5, fixed="X < 0.01")), lambda interaction, time: None)

    def carry_out(verb: str, worker: str = "") -> tuple[str, str]:
        reply = commands.carry_out(pb.Command(client="anna", verb=verb, worker=worker))
        return reply.worker, reply.error

    refused = "this server has no local workers: it was started without --workers, or needs none"
    assert carry_out("add_worker") == carry_out("kill_worker", "local-1") == ("", refused)
    commands.supervisor = world.supervisor
    assert carry_out("add_worker") == ("local-2", "")
    assert "local-2" in world.started[1].command
    assert carry_out("kill_worker", "local-9") == ("", "no local worker 'local-9'; there is local-1, local-2")
    assert carry_out("kill_worker", "local-2") == ("local-2", "") and world.started[1].returncode == -9
    assert world.started[0].returncode is None
    assert carry_out("kill_worker", "local-2")[1].startswith("worker local-2 has no process now")
    world.supervisor.check()
    assert world.pass_until_restart() == pytest.approx(BACK_OFF, abs=0.06)
    assert [(w.state, w.restarts, w.exit_code) for w in world.supervisor.local_workers()][1] == ("running", 1, -9)


def test_the_number_of_workers_is_bounded_and_one_left_alone_comes_first() -> None:
    world = World()
    world.supervisor.workers[0].given_up = True
    names = [world.supervisor.add() for _ in range(MAX_WORKERS)]
    assert names == [f"local-{i + 1}" for i in range(MAX_WORKERS)]
    with pytest.raises(ValueError, match=f"there are {MAX_WORKERS} local workers; allowed are at most {MAX_WORKERS}"):
        world.supervisor.add()
    assert len(world.started) == 1 + MAX_WORKERS
