# SPDX-License-Identifier: MIT
"""Measures a combination of settings as `sim-client accuracy` measures its points, and keeps it among them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from clients.accuracy.axes import SceneValues
from clients.accuracy.errors import point_of
from clients.accuracy.points import Points, Settings, save
from clients.accuracy.runs import Run, Task, run_point
from clients.accuracy.trajectories import load_trajectory
from clients.errors import BadInput

AXIS = "combination"  # of the points that are added


def measure(
    scene: Path, path: Path, found: Points, probed: Run, settings: Settings, left: float, tick: Callable[[], None]
) -> bool:
    """Adds a point with these settings to `found` and its file; returns False if it was not over in `left` seconds.

    path: of points.json; probed: a run of the scene as it is. Raises BadInput if the run of the reference is gone.
    """
    reference = load_trajectory(path.parent / "runs" / "reference.npz")
    if reference is None:
        raise BadInput(f"{path.parent}: the run of the reference is gone; --measure needs it to compare with")
    values = SceneValues(probed.scene, found.device)
    task = Task(scene, values.dt, found.duration, found.interval, found.device)
    run = run_point(task, settings, int(values.wants_workers(settings)), left, tick)
    if run.status == "timed out":
        return False
    if run.status == "refused":
        found.left_out.append({"axis": AXIS, "settings": settings, "reason": run.reason})
    else:
        sizes = {name: values["size"] for name, values in found.objects.items()}
        found.points.append(point_of(AXIS, settings, run, reference, sizes))
    save(found, path)
    return True
