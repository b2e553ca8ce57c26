# SPDX-License-Identifier: MIT
"""Runs of a standard scene: positions at the ends of its time steps, times, how far two of them are apart."""

import fcntl
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.accuracy.trajectories import shared_nodes
from protocol import messages_pb2 as pb
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.accuracy.cases import EXPLICIT, NEWTON, Case, Settings, overrides, usual

Reals = NDArray[np.float64]
LIMIT = 120.0  # s of wall time that a run may take
FINEST = 16  # steps in one of dt, of a reference without explicit substeps
SHARE = 0.2  # of the stable step: substeps of the finer explicit reference have half of it
WELL = (pb.CONVERGED, pb.MAX_LINEARIZATIONS)  # all linear systems were solved
AWAY = (pb.NOT_FINITE, pb.RUNAWAY)


@dataclass
class Motion:
    """interval [s]: between two of frames (k, nodes, 3) [m], the first one interval after the start.

    status: done, diverged, failed or timed out, as a point of a work-precision page has it.
    """

    interval: float
    frames: Reals
    rest: Reals
    tets: int
    records: NDArray[Any]
    device: str
    status: str = "done"
    reason: str = ""

    @property
    def milliseconds(self) -> Reals:
        """Of each step but the first: processor time of the loop's thread, on a GPU time of the device."""
        return 1e3 * np.asarray(self.records["cpu" if self.device == "cpu" else "whole"][1:], dtype=float)

    @property
    def unconverged(self) -> int:
        """Steps with a linear system, or a contact, that was not solved."""
        return int((~np.isin(self.records["status"], WELL)).sum())


def move(case: Case, settings: Settings, device: str = "cpu", limit: float = LIMIT) -> Motion:
    """A run whose first factor is that of the first matrix."""
    try:
        sim = Simulation.load(case.file, overrides(case, settings), device)
    except InputError as error:
        none = np.empty((0, 0, 3))
        return Motion(case.dt, none, np.empty((0, 3)), 0, np.empty(0), device, "failed", str(error))
    dt = sim.world.dt
    interval = max(dt, case.dt)
    each = round(interval / dt)
    driver, records, frames, status, reason = Driver(sim), [], [], "done", ""
    with _alone(device):
        began = time.monotonic()
        for number in range(int(case.seconds / interval + 1e-6)):
            first = number == 0 and driver.wants_factors
            if first:
                records.append(driver.step_with_fresh_factors())
            records.append(driver.advance(each - first))
            frames.append(sim.fetch().x.copy())
            if np.isin(records[-1]["status"], AWAY).any() or not np.isfinite(frames[-1]).all():
                status, reason = "diverged", f"at {(number + 1) * interval:.3g} s"
                break
            if time.monotonic() - began > limit:
                status, reason = "timed out", f"after {limit:g} s, at {(number + 1) * interval:.3g} s"
                break
    w = sim.world
    return Motion(interval, np.array(frames), w.rest.copy(), len(w.bodies[0].mesh.tets), np.concatenate(records),
                  device, status, reason)  # fmt: skip


@contextmanager
def _alone(device: str) -> Iterator[None]:
    """Waits until no other process makes steps on a GPU: parts of the benchmark may run side by side."""
    if device == "cpu":
        yield
        return
    with (Path(tempfile.gettempdir()) / "warpfactor-bench-accuracy.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def distances(a: Motion, b: Motion) -> Reals:
    """Of the nodes that both have [m], (times that both have, nodes): by their places at rest."""
    interval = max(a.interval, b.interval)
    first, second = (m.frames[round(interval / m.interval) - 1 :: round(interval / m.interval)] for m in (a, b))
    if a.rest.shape != b.rest.shape:
        first_nodes, second_nodes = shared_nodes(a.rest, b.rest)
        first, second = first[:, first_nodes], second[:, second_nodes]
    number = min(len(first), len(second))
    return np.asarray(np.linalg.norm(first[:number] - second[:number], axis=2))


def error(a: Motion, b: Motion) -> float | None:
    """Largest distance [m] of a node at any time; None if one of them did not get to its end."""
    if a.status != "done" or b.status != "done":
        return None
    return float(distances(a, b).max())


def rms(a: Motion, b: Motion) -> float | None:
    """Root mean square of the distances [m] over times and nodes; None as above."""
    if a.status != "done" or b.status != "done":
        return None
    return float(np.sqrt((distances(a, b) ** 2).mean()))


# --- what others are compared with ------------------------------------------------------------------------------------


def exact_step(case: Case, more: Settings) -> Motion:
    """The same time step and scheme, each step's equation solved to rounding by Newton-Raphson."""
    return _kept(case, tuple(usual(more, NEWTON, case.exact).items()))


def exact_solve(case: Case) -> Motion:
    """The scene's time step and scheme, one linearization, its linear system solved to rounding."""
    return _kept(case, tuple(usual({"solver.tolerance": "1e-12"}).items()))


@dataclass
class Reference:
    """The motion as small steps make it, and how far that of steps twice as long is apart [m]. settings: of it."""

    motion: Motion
    apart: float
    settings: dict[str, str]


def reference(case: Case, more: Settings | None = None) -> Reference:
    """Of the scene with some of its keys changed: mesh or law, no key of the integrator or of the time step.

    In contact, where steps are of first order, extrapolated from a time step and twice that.
    """
    return _reference(case, tuple((more or {}).items()))


@cache
def _reference(case: Case, more: tuple[tuple[str, str], ...]) -> Reference:
    several = _substeps(case, more) if case.explicit else FINEST
    scheme = EXPLICIT if case.explicit else _implicit(case)
    settings = [usual(dict(more), scheme, case.stepped(case.dt / n)) for n in (several, several // 2, several // 4)]
    fine, coarse = (_kept(case, tuple(one.items())) for one in settings[:2])
    if case.contact:
        fine, coarse = extrapolated(fine, coarse), extrapolated(coarse, _kept(case, tuple(settings[2].items())))
    apart = error(fine, coarse)
    if apart is None:
        raise RuntimeError(f"no reference of {case.name}: {fine.status} {fine.reason} {coarse.reason}")
    return Reference(fine, apart, settings[0])


def extrapolated(fine: Motion, coarse: Motion) -> Motion:
    """Of first order, from a time step and twice that."""
    return replace(fine, frames=2 * fine.frames - coarse.frames)


def _implicit(case: Case) -> dict[str, str]:
    """Settings of small steps: of second order, but for contact, in which bodies take backward Euler."""
    tight = NEWTON | {"integrator.tolerance": "1e-8", "solver.tolerance": "1e-8"} | case.exact
    return tight if case.contact else {"integrator.scheme": "newmark"} | tight


def _substeps(case: Case, more: tuple[tuple[str, str], ...]) -> int:
    """Explicit substeps in one of dt."""
    sim = Simulation.load(case.file, overrides(case, dict(more) | EXPLICIT))
    stable = float(Driver(sim).advance(1)["stable_step"].min())
    return 2 * int(np.ceil(case.dt / (SHARE * stable)))


@cache
def _kept(case: Case, settings: tuple[tuple[str, str], ...]) -> Motion:
    return move(case, dict(settings), limit=np.inf)
