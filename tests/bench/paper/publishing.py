# SPDX-License-Identifier: MIT
"""Asynchronous steps with a worker process that gets matrices, beside the very same steps without publishing.

Two simulations in this process take turns, a stretch of steps each. The loop of the first runs freely on a core of its
own, its matrices go to a worker process on another core, its factors come back. The second is given each of these
factors before the step at which the first has taken it up, and sends nothing: its iterations are the same, step by
step, and what differs is what publishing costs.
"""

import os
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.network.link import ServerLink
from sim_server.service.supervisor import Supervisor
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job
from tests.bench.build.runs import started, until
from tests.bench.harness.cores import Cores
from tests.bench.paper.beam import COROTATIONAL, LOADS, Beam, calibrated
from tests.bench.paper.tables import Row, Setting
from tests.ports import free_endpoint
from tests.support.link import link_of

STRETCH = 50  # steps in turn
COLD = 2  # first steps of a stretch, left out
FIRST = 3  # factor with which counting starts
STEPS = {540: 600, 3000: 600, 7350: 600, 24000: 300}  # of a round
NAP = 5e-4  # s between two looks of the service thread
PATIENCE = 60.0  # s for the first factors

Records = NDArray[Any]


@dataclass
class Published:
    """The simulation with a worker. adopted: factors since the last stretch, by step; sent: steps of its matrices."""

    sim: Simulation
    link: ServerLink
    cores: Cores
    adopted: dict[int, Factor] = field(default_factory=dict)
    sent: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.driver = Driver(self.sim, self.link.dispatch, counted=False)
        self.driver.on_adopt.append(self._adopted)
        submit = self.link.dispatch.submit

        def noted(job: Job) -> bool:
            taken = submit(job)
            if taken:
                self.sent.add(job.step)
            return taken

        self.link.dispatch.submit = noted  # type: ignore[method-assign]

    def _adopted(self, factor: Factor) -> None:
        self.adopted[factor.step] = factor

    def stretch(self, steps: int) -> Records:
        """The loop freely on its core, the service thread beside it."""
        loop = threading.Thread(target=_pinned, args=(self.cores, lambda: self.sim.engine.run(steps)))
        found = []
        loop.start()
        while loop.is_alive():
            found.append(self.driver.pump())
            time.sleep(NAP)
        return np.concatenate([*found, self.driver.pump()])


def _pinned(cores: Cores, work: Any) -> None:
    """In a thread of its own."""
    os.sched_setaffinity(0, cores.loop)
    work()


def repeated(sim: Simulation, cores: Cores, records: Records, factors: dict[int, Factor], in_use: int) -> Records:
    """The steps of a stretch once more, each factor put in before the step that used it first. in_use: before them."""

    def run() -> None:
        done, last = 0, in_use
        for k, made in enumerate(records["factor_step"].tolist()):
            if made != last:
                if k > done:
                    sim.engine.run(k - done)
                factor, done, last = factors[made], k, made
                sim.engine.post_factor(0, factor.pattern, factor.values, factor.step)
        sim.engine.run(len(records) - done)

    thread = threading.Thread(target=_pinned, args=(cores, run))
    thread.start()
    thread.join()
    return sim.engine.records()


@dataclass
class Pair:
    """Steps that count, with and without publishing, and whether a matrix of each was sent."""

    on: Records
    off: Records
    sent: NDArray[np.bool_]


def one_round(beam: Beam, setting: Setting, steps: int, cores: Cores) -> Pair:
    """A server with a worker process, from rest."""
    solver = {"preconditioner": "cholesky", "update": "async", "warp": True, **setting.solver()}
    sim, twin = (beam.simulation(LOADS[1], **solver) for _ in range(2))
    endpoint = free_endpoint()
    with link_of(sim, endpoint, "bench") as link:

        def start(command: Any) -> Any:
            process = started(command)
            os.sched_setaffinity(process.pid, cores.worker)  # before it has threads, which inherit this
            return process

        workers = Supervisor(1, "bench", [endpoint], start=start)
        try:
            until(link.dispatch.workers)
            return _taking_turns(Published(sim, link, cores), twin, steps)
        finally:
            workers.close()


def _taking_turns(one: Published, twin: Simulation, steps: int) -> Pair:
    on, off, counted = [], [], 0
    in_use, end = -1, time.monotonic() + PATIENCE
    while counted < steps:
        warm = one.driver.bodies[0].factors.used >= FIRST
        if not warm and time.monotonic() > end:
            raise RuntimeError(f"no {FIRST} factors within {PATIENCE:g} s")
        records = one.stretch(STRETCH)
        again = repeated(twin, one.cores, records, one.adopted, in_use)
        in_use = int(records["factor_step"][-1])
        one.adopted = {step: factor for step, factor in one.adopted.items() if step >= in_use}
        if warm:
            on.append(records[COLD:])
            off.append(again[COLD:])
            counted += STRETCH
    on_, off_ = np.concatenate(on), np.concatenate(off)
    return Pair(on_, off_, np.isin(on_["step"] - 1, list(one.sent)))


def publishing(setting: Setting, tets: int) -> list[Row]:
    """A size: rounds of steps from rest, all put together."""
    cores, before = Cores.of_this_process(), os.sched_getaffinity(0)
    beam = Beam(setting.sizes[tets], COROTATIONAL,
                calibrated(setting.cells, COROTATIONAL, setting.condition)[0].stiffness)  # fmt: skip
    os.sched_setaffinity(0, cores.service)  # of the threads begun from now on too
    try:
        pairs = [one_round(beam, setting, 2 * STRETCH if setting.quick else STEPS[tets], cores)
                 for _ in range(setting.rounds)]  # fmt: skip
    finally:
        os.sched_setaffinity(0, before)
    on, off = (np.concatenate([getattr(pair, name) for pair in pairs]) for name in ("on", "off"))
    return [_row(tets, str(cores), on, off, np.concatenate([pair.sent for pair in pairs]))]


def _row(tets: int, cores: str, on: Records, off: Records, sent: NDArray[np.bool_]) -> Row:
    """on, off: records of the same steps."""
    (p50, p99), (p50_off, p99_off) = (1e3 * np.percentile(r["whole"], [50, 99]) for r in (on, off))
    wall, cpu = (on[name] / off[name] - 1 for name in ("whole", "cpu"))
    return {
        "device": "cpu", "tets": tets, "cores": cores, "steps": len(on), "steps a matrix": len(on) / max(sent.sum(), 1),
        "iterations": float(on["iterations"].mean()),
        "p50 ms": float(p50), "p99 ms": float(p99), "p99 / p50": float(p99 / p50),
        "p50 off ms": float(p50_off), "p99 off ms": float(p99_off), "p99 / p50 off": float(p99_off / p50_off),
        "publishing %": 100 * float(np.median(wall)), "publishing, CPU %": 100 * float(np.median(cpu)),
        "of steps that publish %": 100 * float(np.median(wall[sent])) if sent.any() else 0.0,
        "the same, CPU %": 100 * float(np.median(cpu[sent])) if sent.any() else 0.0,
        "unconverged": int((on["status"] != 0).sum()),
        "repeats": bool(np.array_equal(on["iterations"], off["iterations"])),
    }  # fmt: skip
