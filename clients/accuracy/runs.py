# SPDX-License-Identifier: MIT
"""Runs a scene once at some settings in a process of sim-server, and reads what the log tells of it."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.accuracy.points import Settings
from clients.accuracy.trajectories import Trajectory, read_trajectory
from clients.errors import BadInput, ClientError
from clients.load_test.processes import end, free_endpoint
from clients.log.reader import Log
from protocol.process.own_python import own_module

LOG_FOLDER = "warpfactor-accuracy-"  # and more letters: folder of the log of a run
POLL = 0.05  # s between looks at a process
ATTEMPTS = 3  # of a start whose port was taken meanwhile
SOLVED = ("converged", "max_linearizations")  # every linear system was solved
RUN_AWAY = ("runaway", "not_finite")


@dataclass(frozen=True)
class Task:
    """What all runs have in common.

    interval: simulated time between compared frames [s]; each dt divides it
    """

    scene: Path
    dt: float  # of the scene [s]
    duration: float  # simulated [s]
    interval: float
    device: str = "auto"


@dataclass
class Run:
    """Outcome of a run. status: done, diverged, failed, timed out or refused (by the server, code 2)."""

    status: str
    reason: str = ""
    trajectory: Trajectory | None = None
    seconds: float | None = None  # wall time of the steps of a simulated second
    step_ms: dict[str, float] | None = None
    iterations: float | None = None
    unconverged: int = 0
    wall: float = 0.0  # s, with start and end of the process
    scene: dict[str, Any] = field(default_factory=dict)  # resolved
    device: str = ""
    software: str = ""
    elements: dict[str, int] = field(default_factory=dict)  # by object
    read: Any = None  # what `read` of run_point returned


def run_point(
    task: Task,
    settings: Settings,
    workers: int = 0,
    timeout: float = 600.0,
    tick: Callable[[], None] = lambda: None,
    folder: Path | None = None,
    read: Callable[[Log], Any] = lambda log: None,
) -> Run:
    """Runs the scene at `settings` for the duration of the task, and returns what came of it.

    The process ends before this returns, whatever happens. `tick` is called about every POLL seconds.
    timeout: wall time of the whole process [s]. folder: for the log, which is removed; by default a temporary one.
    read: is given the log of a run that is done, and may raise BadInput.
    """
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=LOG_FOLDER, dir=folder) as place:
        log, said = Path(place) / "run.mcap", Path(place) / "said.txt"
        code = _serve(task, settings, workers, began + timeout, tick, log, said)
        run = _outcome(code, log, said, task.interval)
        if run.status == "done":
            with Log(log) as found:
                run.read = read(found)
    run.wall = time.monotonic() - began
    if run.status == "timed out":
        run.reason = f"not over after {timeout:.3g} s"
    return run


def command(task: Task, settings: Settings, workers: int, log: Path, endpoint: str) -> list[str]:
    """Returns the command line of a run."""
    dt = time_step(task, settings)
    words = own_module("sim_server", str(task.scene), "--free-run", "--quiet", "--record", str(log))
    words += ["--steps", str(round(task.duration / dt)), "--device", task.device]
    words += ["--name", f"accuracy-{os.getpid()}", "--listen", endpoint, "--workers", str(workers)]
    if workers and task.device != "cpu":
        words += ["--worker-device", "auto"]
    shown = {**settings, "record.every": str(max(1, round(task.interval / dt)))}
    return words + [word for key, value in shown.items() for word in ("--set", f"{key}={value}")]


def time_step(task: Task, settings: Settings) -> float:
    """Returns the time step of a run [s]."""
    return float(settings.get("dt", task.dt))


def _serve(
    task: Task, settings: Settings, workers: int, deadline: float, tick: Callable[[], None], log: Path, said: Path
) -> int | None:
    """Runs the server; returns its exit code, None if it was not over in time."""
    for _ in range(ATTEMPTS):
        words = command(task, settings, workers, log, free_endpoint())
        with said.open(
            "wb"
        ) as out:  # in a session of its own: Ctrl-C reaches this process alone, which ends the server
            process = subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
        try:
            while process.poll() is None:
                if time.monotonic() > deadline:
                    return None
                tick()
                time.sleep(POLL)
        finally:
            end(process)
        if process.returncode != 2 or "another sim-server" not in said.read_text(errors="replace"):
            break
    return process.returncode


def _outcome(code: int | None, log: Path, said: Path, interval: float) -> Run:
    if code is None:
        return Run("timed out")
    if code:
        lines = [line.removeprefix("sim-server: ") for line in said.read_text(errors="replace").strip().splitlines()]
        reason = (lines[-1] if lines else f"sim-server ended with code {code}")[:500]
        return Run("refused" if code == 2 else "failed", reason)
    try:
        with Log(log) as found:
            return read_run(found, interval)
    except (BadInput, ClientError) as error:
        return Run("failed", f"its log cannot be read: {error}")


def read_run(log: Log, interval: float) -> Run:
    """Reads a run from its log; it has diverged where a body has run away or is not finite."""
    run = Run("failed", "; ".join(log.notes) or "its log holds no frames to compare")
    steps = {name: log.scalars(name) for name in log.objects}
    steps = {name: found for name, found in steps.items() if len(found["step"])}
    if not log.complete or log.scene is None or not steps:
        return run
    run.scene, run.device, run.software = json.loads(log.scene.resolved or "{}"), log.scene.device, log.scene.software
    run.trajectory = read_trajectory(log, interval)
    run.elements = {name: len(log.mesh(name, min(found.meshes)).tets) for name, found in log.objects.items()}
    if not len(run.trajectory.times):
        return run
    whole = next(iter(steps.values()))
    times = 1e3 * whole["step_seconds"]
    states = np.concatenate([found["status"] for found in steps.values()])
    run.status, run.reason, run.step_ms = "done", "", step_times(times)
    run.seconds = 1e-3 * float(times.sum()) / float(whole["time"][-1])
    run.iterations = float(sum(found["iterations"].sum() for found in steps.values()) / len(times))
    run.unconverged = int((~np.isin(states, SOLVED)).sum())
    bad = {name: set(found["status"].tolist()) & set(RUN_AWAY) for name, found in steps.items()}
    if not run.trajectory.finite or any(bad.values()):
        run.status = "diverged"
        words = [f"{name}: {', '.join(sorted(found))}".replace("_", " ") for name, found in bad.items() if found]
        run.reason = "; ".join(words[:5]) or "positions are not finite"
    return run


def step_times(milliseconds: NDArray[np.float64]) -> dict[str, float]:
    """Returns p50, p99 and max of the times of steps [ms]."""
    p50, p99 = np.percentile(milliseconds, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(milliseconds.max())}
