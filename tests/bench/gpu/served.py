# SPDX-License-Identifier: MIT
"""The beams with a real worker: a process of its own, matrices and factors over shared memory, as fast as it goes.

As in the server, the loop runs in a thread that has let go of Python's lock and a second one serves it each
millisecond. Every 100 steps (3 s of motion) the beam is put back to where it started, so that it keeps swinging; a
factor made before that helps after it as any old one does.
"""

import inspect
import tempfile
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from protocol.process.memory import keep_long_lived
from sim_server.service.service import ROUND_PERIOD
from sim_server.service.supervisor import Supervisor
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job
from tests.bench.gpu.problem import Problem
from tests.ports import free_endpoint
from tests.state import put
from tests.support.link import link_of

SWING = 100  # steps until the beam is put back
PATIENCE = 60.0  # s for a worker to join, for a first factor to come
SIZES = (540, 3000, 7350, 24_000)

Row = dict[str, Any]


def gpu_worker() -> bool:
    """Whether precond-worker can be put on a GPU."""
    from precond_worker.cli import work

    return "device" in inspect.signature(work).parameters


class Served:
    """A swinging beam, its server and, inside `with`, a worker. worker: cpu or gpu."""

    def __init__(self, sim: Simulation, worker: str):
        self.sim, self.engine, self._worker = sim, sim.engine, worker
        self._start = sim.fetch().x.copy()
        self._endpoint = free_endpoint()
        self._on_device: Any = None  # where it begins
        self._ended = False

    def __enter__(self) -> Self:
        self.link = link_of(self.sim, self._endpoint, "bench")
        arguments = ("--device", "gpu") if self._worker == "gpu" else ()
        self._supervisor = Supervisor(1, "bench", [self._endpoint], arguments)
        self.driver = Driver(self.sim, self.link.dispatch)
        keep_long_lived()  # as the server does
        self.engine.loop.stop = 0
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._ended, self.engine.loop.stop = True, 1
        while self._thread.is_alive():
            self.engine.records()  # it may wait for room
            self._thread.join(0.01)
        self.engine.loop.stop = 0
        self._supervisor.close()
        self.link.close()

    def _loop(self) -> None:
        while not self._ended:
            self.engine.run(SWING)
            self._put_back()

    def _put_back(self) -> None:
        """Puts x and v back, on a GPU by copies within the device: what comes from the host takes as long as steps."""
        world, backend = self.sim.world, self.sim.world.backend
        if backend.name != "gpu":
            put(self.sim, world.x, self._start)
            put(self.sim, world.v, 0.0)
            return
        twins = backend.twin(world.x), backend.twin(world.v)
        if self._on_device is None:
            self._on_device = backend.cp.asarray(self._start.astype(twins[0].dtype))
        twins[0][...] = self._on_device
        twins[1].fill(0)
        self.engine.restart_energy()
        backend.cp.cuda.get_current_stream().synchronize()

    def helped(self, seconds: float) -> NDArray[Any]:
        """Records of `seconds` with factors coming and going; it begins half a second after the first."""
        end = time.monotonic() + PATIENCE
        while self.driver.bodies[0].factors.used == 0:
            if time.monotonic() > end:
                raise RuntimeError(f"no factor of a {self._worker} worker came within {PATIENCE:g} s")
            self.driver.pump()
            time.sleep(ROUND_PERIOD)
        self._pumped(0.5)
        return self._pumped(seconds)

    def _pumped(self, seconds: float) -> NDArray[Any]:
        found, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            found.append(self.driver.pump())
            time.sleep(ROUND_PERIOD)
        return np.concatenate(found)

    def publishing(self, seconds: float, on: bool) -> tuple[NDArray[Any], int]:
        """Records of `seconds` in which matrices leave for the worker as fast as it takes them, or none does; and how
        many left. The factor stays the same: what comes back is thrown away."""
        wanted: NDArray[np.float64] | None = None
        found, sent, end = [], 0, time.monotonic() + seconds
        while time.monotonic() < end:
            found.append(self.engine.records())
            self.link.dispatch.poll(), self.link.dispatch.failures()
            if wanted is not None and (step := self.engine.matrix_step(0)) >= 0:
                sent += self.link.dispatch.submit(Job("beam0", 1, step, True, wanted))
                wanted = None
            if on and wanted is None and self.link.dispatch.ready():
                wanted = np.empty_like(self.sim.system.values)
                self.engine.request_matrix(0, wanted)
            time.sleep(ROUND_PERIOD)
        while wanted is not None and self.engine.matrix_step(0) < 0:
            time.sleep(ROUND_PERIOD)
        return np.concatenate(found), sent


def row(records: NDArray[Any]) -> Row:
    """Of the steps that had a factor."""
    r = records[records["factor_step"] >= 0]
    us, age = 1e6 * r["whole"], r["step"] - 1 - r["factor_step"]
    return {
        "steps": len(r), "us p50": float(np.percentile(us, 50)), "us p99": float(np.percentile(us, 99)),
        "us max": float(us.max()), "iterations": float(r["iterations"].mean()), "most": int(r["iterations"].max()),
        "factor age": float(age.mean()), "oldest": int(age.max()), "residual": float(r["residual"].max()),
    }  # fmt: skip


def measure(
    problem: Problem, seconds: float = 1.0, device: str = "gpu", overrides: tuple[str, ...] = ()
) -> tuple[list[Row], list[Row]]:
    """Rows with each kind of worker, and rows with and without matrices leaving."""
    with tempfile.TemporaryDirectory() as folder:
        sim = Simulation.load(problem.write(Path(folder)), list(overrides), device=device)
    rows, publishing = [], []
    label = {"tets": problem.tets, "material": problem.material}
    for worker in ("cpu", "gpu") if device == "gpu" and gpu_worker() else ("cpu",):
        with Served(sim, worker) as served:
            rows.append({**label, "worker": worker, **row(served.helped(seconds))})
            print(rows[-1], flush=True)
            if worker == "cpu":
                publishing = [{**label, **r} for r in _published(served, 0.25 * seconds)]
    return rows, publishing


def _published(served: Served, seconds: float, turns: int = 4) -> list[Row]:
    found: dict[bool, list[NDArray[Any]]] = {True: [], False: []}
    sent = 0
    for turn in range(2 * turns):
        records, count = served.publishing(seconds, on := turn % 2 == 1)
        found[on].append(records)
        sent += count
    rows = []
    for on, records in found.items():
        one = row(np.concatenate(records))
        kept = {k: one[k] for k in ("steps", "us p50", "us p99", "us max", "iterations")}
        rows.append({"matrices": "leaving" if on else "none", "left": sent if on else 0, **kept})
    print(rows, flush=True)
    return rows
