# SPDX-License-Identifier: MIT
"""Trajectories of the nodes of all objects at common times, and distances between two of them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from clients.log.atomic_file import atomic_file
from clients.log.reader import Log

SAME_PLACE = 1e-9  # two nodes are one if they are as near at rest, over the size of the object


@dataclass(frozen=True)
class Trajectory:
    """Positions of each object at times that are whole multiples of an interval."""

    times: NDArray[np.int64]  # (k,), in intervals, from 1 on
    rest: dict[str, NDArray[np.float64]]  # (n, 3) [m], by object
    x: dict[str, NDArray[np.float64]]  # (k, n, 3) [m]

    @property
    def finite(self) -> bool:
        return all(bool(np.isfinite(x).all()) for x in self.x.values())


@dataclass(frozen=True)
class Distance:
    """Distance between two trajectories at common times and nodes [m]."""

    error: float  # the largest one of a node
    rms: float  # over nodes and times
    errors: dict[str, float]  # the largest one, by object


def read_trajectory(log: Log, interval: float) -> Trajectory:
    """Reads the frames of a log that lie at multiples of `interval` [s], of each object's first mesh."""
    rest: dict[str, NDArray[np.float64]] = {}
    x: dict[str, NDArray[np.float64]] = {}
    common: NDArray[np.int64] | None = None
    for name, found in log.objects.items():
        if not found.meshes or not found.frames:
            continue
        first = min(found.meshes)
        rest[name] = log.mesh(name, first).rest
        places = {}
        for frame in log.frames(name):
            time = round(frame.time / interval)
            if time > 0 and frame.epoch == first and abs(frame.time / interval - time) < 1e-6:
                places[time] = frame.x
        times = np.array(sorted(places), np.int64)
        common = times if common is None else np.intersect1d(common, times)
        x[name] = np.array([places[time] for time in times.tolist()]).reshape(-1, len(rest[name]), 3)
        if len(common) < len(times):  # an object whose frames are missing shortens all
            x = {n: each[-len(times) :][np.isin(times, common)] for n, each in x.items()}
    return Trajectory(np.zeros(0, np.int64) if common is None else common, rest, x)


def distance(one: Trajectory, other: Trajectory) -> Distance:
    """Measures how far two trajectories are apart, at nodes that both have and times that both have.

    A node of one mesh is that of the other which is at the same place at rest. No common node or time: NaN.
    """
    times, mine, others = np.intersect1d(one.times, other.times, return_indices=True)
    errors: dict[str, float] = {}
    squares, count = 0.0, 0
    for name in one.x:
        if name not in other.x:
            continue
        a, b = shared_nodes(one.rest[name], other.rest[name])
        if not len(times) or not len(a):
            continue
        square = np.square(one.x[name][mine][:, a] - other.x[name][others][:, b]).sum(axis=2)
        errors[name] = float(np.sqrt(square.max()))
        squares += float(square.sum())
        count += square.size
    if not count:
        return Distance(float("nan"), float("nan"), {})
    return Distance(max(errors.values()), float(np.sqrt(squares / count)), errors)


def shared_nodes(one: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the indices of nodes of two meshes that are at the same place at rest."""
    if one.shape == other.shape and np.array_equal(one, other):
        every = np.arange(len(one))
        return every, every
    bound = SAME_PLACE * float(np.ptp(one, axis=0).max())
    far, nearest = (np.asarray(found) for found in KDTree(other).query(one))
    here = np.flatnonzero(far <= bound)
    return here, nearest[here].astype(np.int64)


def extrapolate(base: Trajectory, coarse: Trajectory, fine: Trajectory, factor: float) -> Trajectory:
    """Returns base + factor (fine - coarse) at the nodes and times that all three have (Richardson)."""
    times = np.intersect1d(np.intersect1d(base.times, coarse.times), fine.times)
    rest, x = {}, {}
    for name in base.x:
        if name not in coarse.x or name not in fine.x:
            continue
        a, b = shared_nodes(base.rest[name], coarse.rest[name])
        c, d = shared_nodes(base.rest[name][a], fine.rest[name])
        a, b = a[c], b[c]
        at = [t.x[name][np.isin(t.times, times)] for t in (base, coarse, fine)]
        rest[name] = base.rest[name][a]
        x[name] = at[0][:, a] + factor * (at[2][:, d] - at[1][:, b])
    return Trajectory(times, rest, x)


def save_trajectory(trajectory: Trajectory, path: Path) -> None:
    """Writes an .npz, whole or not at all."""
    arrays = {f"rest/{name}": values for name, values in trajectory.rest.items()}
    arrays |= {f"x/{name}": values for name, values in trajectory.x.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as part:
        np.savez(part, times=trajectory.times, **arrays)  # type: ignore[arg-type]


def load_trajectory(path: Path) -> Trajectory | None:
    """Reads an .npz; None if it is not there or cannot be read."""
    try:
        with np.load(path) as found:
            arrays = dict(found)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
    parts = {
        kind: {name.removeprefix(f"{kind}/"): values for name, values in arrays.items() if name.startswith(f"{kind}/")}
        for kind in ("rest", "x")
    }
    return Trajectory(arrays["times"], parts["rest"], parts["x"])
