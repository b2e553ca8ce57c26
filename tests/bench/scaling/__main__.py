# SPDX-License-Identifier: MIT
"""Throughput and age of the factors from one body to many, with a few workers, on a CPU and on a GPU.

    deploy/run bench scaling                                     on the CPU, all of it
    deploy/run bench scaling --device cpu gpu --worker-device cpu gpu --limit 500 --out a
    deploy/run bench scaling --merge a/scaling.json b/scaling.json

Beams of 540 tetrahedra in one server, worker processes of their own, matrices and factors over shared memory, as fast
as it goes. The loop runs on its own and is served each millisecond, as in sim-server; every 100 steps the beams are put
back to where they started, so that they keep swinging. Where there is no GPU its rows are skipped with a message.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.errors import DeviceError
from sim_server.service.service import ROUND_PERIOD
from sim_server.service.supervisor import Supervisor
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.pieces import Limit, Merged, Piece, arguments_of_pieces, say, shown
from tests.bench.scaling import page
from tests.ports import free_endpoint
from tests.state import put
from tests.support.link import link_of

OBJECTS, WORKERS = (1, 4, 16, 64, 256, 1024), (1, 2, 4)
DEVICES = ("cpu", "gpu")
TITLE = "From one body to many"
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
mesh = {{ bar = [3, 3, 10], size = [1, 1, 4], split = "kuhn" }}
elements = "linear"
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
        endpoint = free_endpoint()
        self.link = link_of(sim, endpoint, "bench")
        self._supervisor = Supervisor(workers, "bench", [endpoint], ["--device", worker_device])
        self.driver = Driver(sim, self.link.dispatch)
        self._thread = threading.Thread(target=self._loop)
        self._ended = False
        self._failure: BaseException | None = None

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
        try:
            while not self._ended:
                self.engine.run(SWING)
                self._put_back()
        except BaseException as error:  # DeviceLost: told by who waits for records
            self._failure = error

    def _put_back(self) -> None:
        put(self.sim, self.sim.world.x, self._start)
        put(self.sim, self.sim.world.v, 0.0)

    def measured(self, seconds: float, warm: float) -> tuple[NDArray[Any], Row]:
        """Records of `seconds`, and what else was counted: steps, factors taken up, seconds.

        It begins when every body has had a factor, or after `warm` seconds of steps.
        """
        end = time.monotonic() + PATIENCE
        while len(self.link.dispatch.workers()) < self.workers:
            if time.monotonic() > end:
                raise RuntimeError(f"{self.workers} workers have not joined within {PATIENCE:g} s")
            time.sleep(ROUND_PERIOD)
        self._thread.start()
        begun = time.monotonic()
        while min(t.factors.used for t in self.driver.bodies) == 0 and time.monotonic() < begun + warm:
            self._round()
        warmed, begun = time.monotonic() - begun, time.monotonic()
        before, steps, dropped, found = self._used(), self.engine.step, self.engine.loop.records_dropped, []
        while time.monotonic() < begun + seconds or not len(found):
            if len(records := self._round()):
                found.append(records)
        return np.concatenate(found), {
            "lasted": time.monotonic() - begun, "steps": self.engine.step - steps, "warm": warmed,
            "factors": self._used() - before, "dropped": int(self.engine.loop.records_dropped) - dropped,
        }  # fmt: skip

    def _round(self) -> NDArray[Any]:
        if self._failure is not None:
            raise self._failure
        records = self.driver.pump()
        time.sleep(ROUND_PERIOD)
        return records

    def _used(self) -> int:
        return sum(t.factors.used for t in self.driver.bodies)


def measure(objects: int, workers: int, seconds: float, warm: float, device: str, worker_device: str) -> Row:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "beams.toml"
        path.write_text(scene(objects))
        begun = time.monotonic()
        sim = Simulation.load(path, [], device)
        loaded = time.monotonic() - begun
    with Run(sim, workers, worker_device) as run:
        r, counted = run.measured(seconds, warm)
        helped = sum(t.factors.used > 0 for t in run.driver.bodies)
    whole = 1e3 * r["whole"][r["body"] == 0]
    age = (r["step"] - 1 - r["factor_step"])[r["factor_step"] >= 0]
    lasted, steps = counted["lasted"], counted["steps"]
    return {
        "objects": objects, "server": device, "workers": workers, "workers on": worker_device,
        "object-steps/s": objects * steps / lasted, "steps/s": steps / lasted,
        "step ms p50": _percentile(whole, 50), "step ms p99": _percentile(whole, 99),
        "age p50, steps": _percentile(age, 50), "age max, steps": int(age.max()) if len(age) else None,
        "age p50, ms": _milliseconds(_percentile(age, 50), lasted, steps),
        "age max, ms": _milliseconds(_percentile(age, 100), lasted, steps),
        "iterations": float(r["iterations"].mean()), "most": int(r["iterations"].max()),
        "factors/s": counted["factors"] / lasted, "with a factor": helped,
        "unconverged": int((r["status"] != 0).sum()), "records dropped": counted["dropped"],
        "warm s": counted["warm"], "load s": loaded,
    }  # fmt: skip


def _percentile(values: NDArray[np.float64], q: float) -> float | None:
    return float(np.percentile(values, q)) if len(values) else None


def _milliseconds(age: float | None, lasted: float, steps: int) -> float | None:
    return None if age is None or not steps else 1e3 * age * lasted / steps


def usable(devices: list[str]) -> list[str]:
    """Those of this machine; says why the others are skipped."""
    if "gpu" not in devices:
        return devices
    from sim_server.backends.gpu.device import cupy

    try:
        cupy()
    except DeviceError as error:
        say(f"skipped: gpu: {error}")
        return [d for d in devices if d != "gpu"]
    return devices


def plan(o: argparse.Namespace) -> list[tuple[int, int, str, str]]:
    """(objects, workers, device, device of the workers) of each row; smallest first."""
    pairs = [(d, w) for d in usable(o.device) for w in (usable(o.worker_device) if o.worker_device else [d])]
    return [(n, workers, *pair) for n in sorted(o.objects) for pair in pairs for workers in o.workers]


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--objects", type=int, nargs="+", default=list(OBJECTS))
    parser.add_argument("--workers", type=int, nargs="+", default=list(WORKERS))
    parser.add_argument("--seconds", type=float, default=5.0, help="measured for each row")
    parser.add_argument("--warm", type=float, default=30.0, help="seconds at most until every body has a factor")
    parser.add_argument("--device", choices=DEVICES, nargs="+", default=["cpu"], help="of the server")
    parser.add_argument("--worker-device", choices=DEVICES, nargs="+", help="of its workers [default: as the server]")
    parser.add_argument("--quick", action="store_true", help="fewest objects and workers, an instant each")
    arguments_of_pieces(parser)
    o = parser.parse_args()
    if o.quick:
        o.objects, o.workers, o.seconds = [1, 3], [1], 0.3
    if min(o.objects) < 1 or min(o.workers) < 1 or not o.seconds > 0:
        parser.error("--objects, --workers and --seconds must be above 0")
    return o


def main() -> None:
    o = options()
    if o.merge:
        merged = Merged("scaling", TITLE, o.merge, o.out)
        page.write(merged, merged.rows("rows", page.KEYS))
        return
    arguments = {k: getattr(o, k) for k in ("objects", "workers", "seconds", "warm", "device")}
    arguments |= {k: getattr(o, k) for k in ("worker_device", "quick") if getattr(o, k)}
    report, limit, rows = Piece("scaling", TITLE, arguments, o.out, o.quick), Limit(o.limit), []
    for n, workers, device, worker_device in plan(o):
        name = f"{n} objects on {device}, {workers} workers on {worker_device}"
        if limit.reached(name):
            continue
        try:
            rows.append(measure(n, workers, o.seconds, o.warm, device, worker_device))
        except Exception as error:  # the other rows are worth having
            say(f"FAILED: {name}: {type(error).__name__}: {error}")
            continue
        say(shown(rows[-1]))
        report.data["rows"] = rows
        report.keep()
    limit.tell()
    if not rows:
        raise SystemExit("bench scaling: nothing was measured")
    page.write(report, rows)


if __name__ == "__main__":
    main()
