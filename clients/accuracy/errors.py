# SPDX-License-Identifier: MIT
"""Points from runs: the error against a reference, and the median time over rounds."""

from __future__ import annotations

import math
from statistics import median

from clients.accuracy.points import Point, Settings
from clients.accuracy.runs import Run
from clients.accuracy.trajectories import Trajectory, distance

FAR = 10.0  # sizes of the object; a run that is farther off has diverged


def point_of(axis: str, settings: Settings, run: Run, reference: Trajectory, sizes: dict[str, float]) -> Point:
    """Makes a point from a run. sizes: of the objects [m]."""
    point = Point(axis, settings, run.status, run.reason)
    if run.seconds is not None:
        point.rounds, point.seconds = [run.seconds], run.seconds
        point.step_ms, point.iterations, point.unconverged = run.step_ms, run.iterations, run.unconverged
    if run.trajectory is None or not run.trajectory.finite:
        return point
    measure(point, run.trajectory, reference, sizes)
    return point


def measure(point: Point, trajectory: Trajectory, reference: Trajectory, sizes: dict[str, float]) -> None:
    """Sets the errors of a point; one that is FAR from the reference has diverged."""
    found = distance(trajectory, reference)
    if math.isnan(found.error):
        point.status, point.reason = "failed", "no node and time to compare with the reference"
        return
    point.error, point.rms, point.errors = found.error, found.rms, found.errors
    off = max(((error / sizes[name], name) for name, error in found.errors.items()), default=(0.0, ""))
    if off[0] > FAR and point.status == "done":
        point.status, point.reason = "diverged", f"{off[1]}: {off[0]:.3g} times its size off"


def add_round(point: Point, run: Run) -> None:
    """Adds the times of a further run of the same settings: the median over rounds, the latest step times."""
    if run.seconds is None:
        return
    point.rounds.append(run.seconds)
    point.seconds = median(point.rounds)
    if point.seconds == run.seconds:
        point.step_ms = run.step_ms


def order_of_convergence(coarse: float, fine: float) -> float | None:
    """Returns the order p from the changes of two halvings, log2(coarse / fine); None if they do not shrink."""
    return math.log2(coarse / fine) if coarse > fine > 0 else None
