# SPDX-License-Identifier: MIT
"""Throughput and age of the factors from one body to many, with a few workers.

Beams of 540 tetrahedra in one server, worker processes of their own, matrices and factors over shared memory, as fast
as it goes. The loop runs on its own and is served each millisecond, as in sim-server; every 100 steps the beams are put
back to where they started, so that they keep swinging.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import socket
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server import describe
from sim_server.driver import Driver
from sim_server.network.link import ServerLink
from sim_server.service import NAP
from sim_server.simulation import Simulation
from sim_server.supervisor import Supervisor
from tests.bench.report import Report, plots

OBJECTS, WORKERS = (1, 4, 16, 64, 256, 1024), (1, 2, 4)
SWING = 100  # steps until the beams are put back
PATIENCE = 60.0  # s for the workers to join

HEAD = """dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[solver]
preconditioner = "cholesky"
"""
BEAM = """[[object]]
name = "beam{number}"
mesh = {{ bar = [3, 3, 10], size = [1, 1, 4] }}
pose = {{ translate = [{x}, 0, {z}] }}
[object.effects]
corotational = {{ young = {young:.0f}, poisson = 0.3 }}
rayleigh = {{ mass = 0.1, stiffness = 0.1 }}
fixed = {{ where = "Z < 0.01" }}
"""

Row = dict[str, Any]


def scene(objects: int) -> str:
    """TOML of so many beams; their stiffness rises from 1 to 4 MPa, so that they do not swing alike."""
    bodies = (
        BEAM.format(number=k, x=3 * (k % 32), z=8 * (k // 32), young=1e6 * (1 + 3 * k / max(objects - 1, 1)))
        for k in range(objects)
    )
    return HEAD + "".join(bodies)


class Run:
    """One simulation with its server and workers; a context manager."""

    def __init__(self, sim: Simulation, workers: int, worker_device: str):
        self.sim, self.engine, self.workers = sim, sim.engine, workers
        self._start = sim.fetch().x.copy()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.link = ServerLink("bench", [endpoint])
        self.link.set_scene(describe.scene(sim))
        for body in sim.world.bodies:
            self.link.announce(describe.topology(sim, body))
        self._supervisor = Supervisor(workers, "bench", [endpoint], ["--device", worker_device])
        self.driver = Driver(sim, self.link)
        self._thread = threading.Thread(target=self._loop)
        self._ended = False

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *_: object) -> None:
        self._ended, self.engine.loop.stop = True, 1
        while self._thread.is_alive():
            self.engine.records()  # it may wait for room
            self._thread.join(0.01)
        self._supervisor.close()
        self.link.close()

    def _loop(self) -> None:
        while not self._ended:
            self.engine.run(SWING)
            world = self.sim.world
            world.x[:], world.v[:] = self._start, 0.0
            if world.backend.name == "gpu":
                for array in (world.x, world.v):
                    world.backend.twin(array).set(array)
                world.backend.cp.cuda.Device().synchronize()

    def measured(self, seconds: float, warm: float) -> tuple[NDArray[Any], int, float]:
        """Records of `seconds`, factors taken up meanwhile, how long it was [s].

        It begins when every body has had a factor, or after `warm` seconds of steps.
        """
        end = time.monotonic() + PATIENCE
        while len(self.link.workers()) < self.workers:
            if time.monotonic() > end:
                raise SystemExit(f"{self.workers} workers have not joined within {PATIENCE:g} s")
            time.sleep(NAP)
        self._thread.start()
        end = time.monotonic() + warm
        while min(t.used for t in self.driver.tracks) == 0 and time.monotonic() < end:
            self.driver.pump()
            time.sleep(NAP)
        begun, before, found = time.monotonic(), self._used(), []
        while time.monotonic() < begun + seconds or not len(found):
            if len(records := self.driver.pump()):
                found.append(records)
            time.sleep(NAP)
        return np.concatenate(found), self._used() - before, time.monotonic() - begun

    def _used(self) -> int:
        return sum(t.used for t in self.driver.tracks)


def measure(objects: int, workers: int, seconds: float, warm: float, device: str) -> Row:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "beams.toml"
        path.write_text(scene(objects))
        begun = time.monotonic()
        sim = Simulation.load(path, [], device)
        loaded = time.monotonic() - begun
    with Run(sim, workers, device) as run:
        r, factors, lasted = run.measured(seconds, warm)
        helped = sum(t.used > 0 for t in run.driver.tracks)
    whole = 1e3 * r["whole"][r["body"] == 0]
    age = (r["step"] - 1 - r["factor_step"])[r["factor_step"] >= 0]
    return {
        "objects": objects, "workers": workers, "steps/s": len(r) / objects / lasted, "object-steps/s": len(r) / lasted,
        "step ms p50": _percentile(whole, 50), "p99": _percentile(whole, 99),
        "iterations": float(r["iterations"].mean()), "most": int(r["iterations"].max()),
        "factor age, steps": _mean(age), "oldest": int(age.max()) if len(age) else None,
        "factor age, ms": _mean(age * 1e3 * lasted * objects / len(r)), "factors/s": factors / lasted,
        "with a factor": helped,
        "unconverged": int((r["status"] != 0).sum()), "load s": loaded,
    }  # fmt: skip


def _mean(values: NDArray[Any]) -> float | None:
    return float(values.mean()) if len(values) else None


def _percentile(values: NDArray[np.float64], q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def draw(report: Report, rows: list[Row]) -> None:
    """Throughput and age over the number of bodies, a line for each number of workers."""
    plt = plots()
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for name, plot in zip(("object-steps/s", "factor age, ms", "iterations"), axes, strict=True):
        for workers in sorted({r["workers"] for r in rows}):
            mine = [r for r in rows if r["workers"] == workers]
            plot.loglog([r["objects"] for r in mine], [r[name] for r in mine], "o-", label=f"{workers} workers")
        plot.set(xlabel="objects", title=name)
    axes[0].legend()
    report.figure(figure, "scaling.png", "Throughput, mean age of the factors in use, mean iterations.")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--objects", type=int, nargs="+", default=list(OBJECTS))
    parser.add_argument("--workers", type=int, nargs="+", default=list(WORKERS))
    parser.add_argument("--seconds", type=float, default=5.0, help="measured for each row")
    parser.add_argument("--warm", type=float, default=30.0, help="seconds at most until every body has a factor")
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu", help="of the server and its workers")
    parser.add_argument("--quick", action="store_true", help="fewest objects and workers, an instant each")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.quick:
        options.objects, options.workers, options.seconds = [1, 3], [1], 0.3
    if min(options.objects) < 1 or min(options.workers) < 1 or not options.seconds > 0:
        parser.error("--objects, --workers and --seconds must be above 0")
    arguments = {k: getattr(options, k) for k in ("objects", "workers", "seconds", "warm", "device")}
    report = Report("scaling", "From one body to many", arguments, options.out, options.quick)
    rows = []
    for objects in options.objects:
        for workers in options.workers:
            rows.append(measure(objects, workers, options.seconds, options.warm, options.device))
            print({k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
    report.data["rows"] = rows
    report.say(
        "Beams of 540 tetrahedra (176 nodes), E 1 to 4 MPa, dt 20 ms, tolerance 1e-6 of the true residual, as fast as "
        "it goes, the loop on one thread; every 100 steps the beams are put back to where they started. Measured once "
        f"every beam has a factor, or after {options.warm:g} s; those without one are solved with block Jacobi. Age: "
        "of the factor that a solve used, from the matrix it was made from. Server and workers share the cores named "
        "above."
    )
    report.table(rows)
    draw(report, rows)
    report.write()


if __name__ == "__main__":
    main()
