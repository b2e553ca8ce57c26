# SPDX-License-Identifier: MIT
"""How good the estimates of a step's error are: estimated over true, step by step.

Beside the run go two twins, which begin each step where the run does: one solves the same linear system to rounding,
the other the step's own equation. How far the run's nodes are from theirs is the true error.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.accuracy.cases import NEWTON, Case, Settings, accepts, overrides, usual
from tests.bench.accuracy.motion import Reals
from tests.state import put

Row = dict[str, Any]
LINEAR: Settings = {"solver.tolerance": "1e-13"}
STEPS = 60
LEAST = 1e-13  # of the length: a true error below it is rounding, and tells nothing of its estimate
WAYS: dict[str, Settings] = {
    "1 linearization, 1e-3": {"solver.tolerance": "1e-3"},
    "1 linearization, 1e-6": {},
    "1 linearization, 1e-3, not warped": {"solver.tolerance": "1e-3", "solver.warp": "false"},
    "1 linearization, 1e-3, block Jacobi": {"solver.tolerance": "1e-3", "solver.preconditioner": "block_jacobi"},
    "2 linearizations, 1e-3": {"integrator.linearizations": "2", "solver.tolerance": "1e-3"},
}


def ways(case: Case, device: str) -> dict[str, Settings]:
    """Settings by name: those above, in contact on a GPU of one linearization, and bounds of the error."""
    several = not (case.contact and device == "gpu")
    fixed = {name: way for name, way in WAYS.items() if several or "integrator.linearizations" not in way}
    bounds = {f"position = {bound} m": {"accuracy.position": bound} for bound in case.positions}
    return fixed | {name: settings for name, settings in bounds.items() if accepts(case, settings)}


def rows(case: Case, name: str, way: Settings, device: str, steps: int = STEPS) -> list[Row]:
    """A row for each of both estimates that records have.

    That of the linear solve is of the last one of a step, so it is looked at where there is one alone.
    """
    settings = usual(way)
    records, linear, whole = true_errors(case, settings, device, steps)
    one_solve = "integrator.linearizations" not in way and "accuracy.position" not in way
    given = {"solve_error": linear} if one_solve else {}
    return [
        {"device": device, "scene": case.name, "way": name, "estimate": estimate, "settings": settings,
         **judged(np.asarray(records[estimate], dtype=float), true, LEAST * case.length)}
        for estimate, true in (given | {"step_error": whole}).items()
        if estimate in (records.dtype.names or ()) and np.isfinite(records[estimate]).any()
    ]  # fmt: skip


def judged(estimated: Reals, true: Reals, least: float) -> Row:
    """Effectivity over the steps that have an estimate and more error than rounding: median, least, largest.

    true: errors [m], their median and the largest.
    """
    known = np.isfinite(estimated) & (true > least)
    if not known.any():
        return {"steps": 0, "median": None, "least": None, "most": None, "true": None, "true, most": None}
    ratio = estimated[known] / true[known]
    return {
        "steps": int(known.sum()), "median": float(np.median(ratio)), "least": float(ratio.min()),
        "most": float(ratio.max()), "true": float(np.median(true[known])), "true, most": float(true[known].max()),
    }  # fmt: skip


def true_errors(case: Case, settings: Settings, device: str, steps: int) -> tuple[NDArray[Any], Reals, Reals]:
    """Records of a run, and the errors [m] of the linear solve and of the whole of each of its steps."""
    unbound = {key: value for key, value in settings.items() if key != "accuracy.position"}
    run, *twins = (
        Simulation.load(case.file, overrides(case, more), where)
        for more, where in ((settings, device), (unbound | LINEAR, "cpu"), (unbound | NEWTON | case.exact, "cpu"))
    )
    driver, drivers = Driver(run), [Driver(twin) for twin in twins]
    records, errors = [], []
    for _ in range(steps):
        x, v = (np.array(a) for a in (run.fetch().x, run.world.v))
        records.append(driver.advance(1))
        there = []
        for twin, its in zip(twins, drivers, strict=True):
            put(twin, twin.world.x, x)
            put(twin, twin.world.v, v)
            its.advance(1)
            there.append(float(np.linalg.norm(run.fetch().x - twin.fetch().x, axis=1).max()))
        errors.append(there)
    linear, whole = np.array(errors).T
    return np.concatenate(records), linear, whole
