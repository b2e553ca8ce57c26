# SPDX-License-Identifier: MIT
"""Runs of a server loop in this process with one worker process, matrices or positions sent to it."""

import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.recording import messages
from sim_server.updates.driver import Driver
from sim_server.network.link import ServerLink
from sim_server.simulation import Simulation
from sim_server.service.supervisor import Supervisor
from tests.bench.faults.net import ADDRESS, Cable
from tests.bench.harness.schemes import SCENES
from tests.bench.harness.report import ROOT
from tests.ports import free_endpoint
from tests.support.link import link_of

CELLS = {540: (3, 3, 10), 3000: (5, 5, 20), 24000: (10, 10, 40)}  # of sofa_beam.toml
SHARED, BYTES, GIGABIT = "shared memory", "bytes, same host", "1 Gbit/s"
FIRST = 3  # factor with which counting starts


@dataclass(frozen=True)
class Case:
    """One run. build: server, worker, or none: no matrix goes out after the first."""

    tets: int
    way: str
    build: str

    def simulation(self) -> Simulation:
        cells = ",".join(map(str, CELLS[self.tets]))
        overrides = [f"object.beam.mesh.bar=[{cells}]"]
        if self.build == "none":
            overrides += ["solver.update=adaptive", "solver.update_threshold=1e6"]
        else:
            overrides += ["solver.update=async", f"solver.build={self.build}"]
        return Simulation.load(SCENES / "sofa_beam.toml", overrides)


class Found:
    """records: of the steps; seconds: of each factor, in the worker; latencies: steps from copy to factor; pumped:
    processor time of the service thread [s]; wall [s]; jobs, bytes_out: sent meanwhile."""

    def __init__(self, link: ServerLink):
        self._link = link
        self.records: list[NDArray[Any]] = []
        self.seconds: list[float] = []
        self.latencies: list[int] = []
        self._begun, self._began = time.thread_time(), time.monotonic()
        self._jobs, self._sent = link.counters.jobs, link.counters.bytes_out

    @property
    def steps(self) -> int:
        return sum(len(r) for r in self.records)

    def close(self) -> None:
        """Counting ends."""
        self.pumped, self.wall = time.thread_time() - self._begun, time.monotonic() - self._began
        self.jobs = self._link.counters.jobs - self._jobs
        self.bytes_out = self._link.counters.bytes_out - self._sent


def measured(case: Case, steps: int) -> dict[str, Any]:
    """The row of a case, counted from the third factor on (none: from the first)."""
    sim = case.simulation()
    far = case.way == GIGABIT
    endpoint = free_endpoint(ADDRESS if far else "127.0.0.1")
    prefix = Cable.far if far else ()
    with link_of(sim, endpoint, "bench", shared_memory=case.way == SHARED) as link:
        workers = Supervisor(1, "bench", [endpoint], start=lambda command: started([*prefix, *command]))
        try:
            until(link.dispatch.workers)
            return _row(case, _run(sim, link, steps, 1 if case.build == "none" else FIRST))
        finally:
            workers.close()


def started(command: Sequence[str]) -> "subprocess.Popen[bytes]":
    """A worker, silent."""
    quiet = subprocess.DEVNULL  # it says each time that it has no shared memory
    return subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, cwd=ROOT)


def until(condition: Callable[[], Any]) -> None:
    """Waits for a worker."""
    end = time.monotonic() + 30
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError("no worker joined within 30 s")
        time.sleep(0.01)


def _run(sim: Simulation, link: ServerLink, steps: int, first: int) -> Found:
    """The loop freely in a thread of its own, `pump` beside it."""
    driver, found = Driver(sim, link.dispatch, counted=False), Found(link)

    def adopted(factor: Factor) -> None:
        found.seconds.append(factor.seconds)
        found.latencies.append(max(1, sim.engine.step - factor.step))

    driver.on_adopt.append(adopted)
    loop = threading.Thread(target=sim.engine.run, args=(1 << 40,))
    loop.start()
    try:
        while found.steps < steps:
            found.records.append(driver.pump())
            if driver.bodies[0].factors.used < first:
                found = Found(link)
            time.sleep(5e-4)
        found.close()
    finally:
        sim.engine.loop.stop = 1
        loop.join()
    return found


def _row(case: Case, found: Found) -> dict[str, Any]:
    r = np.concatenate(found.records)
    row: dict[str, Any] = {
        "tets": case.tets, "link": case.way, "assembled by": case.build, "step CPU ms": 1e3 * float(r["cpu"].mean()),
        "step p50 ms": 1e3 * float(np.median(r["whole"])), "iterations": float(r["iterations"].mean()),
        "unconverged": int((r["status"] != 0).sum()),
    }  # fmt: skip
    if found.jobs and found.seconds:
        each, pace = found.bytes_out / found.jobs, found.wall / len(r)
        row |= {
            "bytes a job": int(each), "ms at 1 Gbit/s": 1e3 * each / 125e6,
            "service ms a job": 1e3 * found.pumped / found.jobs,
            "worker ms a job": 1e3 * float(np.median(found.seconds)),
            "to factor ms": 1e3 * pace * float(np.mean(found.latencies)), "factors a second": found.jobs / found.wall,
        }  # fmt: skip
    return row


def copies(tets: int, rounds: int) -> dict[str, Any]:
    """What copying for a worker adds to a step: processor time of steps with and without, in turn, medians."""
    sim = Case(tets, "", "server").simulation()
    matrix, positions = np.full_like(sim.system.values, 0), np.full_like(sim.world.x, 0)
    ask: dict[str, Callable[[], None]] = {
        "neither": lambda: None,
        "matrix": lambda: sim.engine.request_matrix(0, matrix),
        "positions": lambda: sim.engine.request_positions(0, positions),
    }
    spent: dict[str, list[float]] = {name: [] for name in ask}
    Driver(sim, counted=True).step_with_fresh_factors()
    for _ in range(rounds):
        for name, request in ask.items():
            request()
            begin = time.thread_time()
            sim.engine.assemble()
            spent[name].append(time.thread_time() - begin)
            sim.engine.solve()
    whole, plain = float(np.median(sim.engine.records()["cpu"])), float(np.median(spent["neither"]))
    row: dict[str, Any] = {"tets": tets, "assembly us": 1e6 * plain, "step us": 1e6 * whole}
    for name in ("matrix", "positions"):
        added = float(np.median(spent[name])) - plain
        row |= {f"{name} us": 1e6 * added, f"{name}, % of step": 100 * added / whole}
    return row
