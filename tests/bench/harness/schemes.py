# SPDX-License-Identifier: MIT
"""Runs a scene under an update scheme, in this process or through server and worker processes."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.report import ROOT
from tests.ports import free_endpoint

Reals = NDArray[np.float64]
SCENES = ROOT / "deploy" / "scenes"


@dataclass(frozen=True)
class Scheme:
    """Overrides of a scene's solver. processes: a real worker in a process of its own instead of this one; realtime: a
    step each dt instead of as fast as it goes."""

    name: str
    solver: tuple[str, ...]
    processes: bool = False
    realtime: bool = False

    def overrides(self, *more: str) -> list[str]:
        return [f"solver.{key}" for key in self.solver] + list(more)


@dataclass
class Run:
    """Step by step (k,). seconds: wall time of a step, with the factorization where the scheme's step waits for one
    (never, every-N), without it where it is made elsewhere (async, lockstep-D)."""

    iterations: Reals
    seconds: Reals
    residual: Reals
    age: Reals  # steps since the factor's matrix; nan without a factor
    status: list[str]
    x: Reals  # (k + 1, nodes, 3) [m]; the first frame is the start


def run(scene: Path, scheme: Scheme, steps: int, more: tuple[str, ...] = (), folder: Path | None = None) -> Run:
    """folder: for the log where there are processes."""
    if scheme.processes:
        assert folder is not None
        return _in_processes(scene, scheme, steps, more, folder)
    sim = Simulation.load(scene, scheme.overrides(*more))
    driver = Driver(sim)
    x, records = [sim.world.x.copy()], []
    for _ in range(steps):
        records.append(driver.advance(1))
        x.append(sim.world.x.copy())
    r = np.concatenate(records)
    age = np.where(r["factor_step"] >= 0, r["step"] - 1 - r["factor_step"], np.nan)
    status = [pb.SolveStatus.Name(s).lower() for s in r["status"].tolist()]  # type: ignore[arg-type]
    return Run(r["iterations"].astype(float), r["whole"], r["residual"], age, status, np.array(x))


def _in_processes(scene: Path, scheme: Scheme, steps: int, more: tuple[str, ...], folder: Path) -> Run:
    """sim-server with one local worker, read back from its log."""
    from clients.log.reader import Log

    path = folder / "run.mcap"
    command = [sys.executable, "-m", "sim_server", str(scene), "--steps", str(steps), "--workers", "1"]
    command += ["--realtime" if scheme.realtime else "--free-run"]
    command += ["--record", str(path), "--listen", free_endpoint(), "--name", "bench", "--quiet"]
    for override in scheme.overrides(*more):
        command += ["--set", override]
    subprocess.run(command, check=True, cwd=ROOT, timeout=600)
    with Log(path) as log:
        name = next(iter(log.objects))
        columns = log.scalars(name)
        x = np.array([frame.x for frame in log.frames(name)])
    path.unlink()
    age = np.where(columns["factor_step"] >= 0, columns["step"] - 1 - columns["factor_step"], np.nan)
    return Run(
        columns["iterations"].astype(float), columns["step_seconds"], columns["residual"], age,
        columns["status"].tolist(), x,
    )  # fmt: skip
