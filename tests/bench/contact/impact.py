# SPDX-License-Identifier: MIT
"""An impact without friction, step by step, by ways to precondition its passes."""

from dataclasses import replace
from typing import Any

import numpy as np

from sim_server.backends.kinds import KINDS
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import FACTOR, FIRST, IMPACT, JACOBI, Row, of_times, solvers, times
from tests.bench.contact.cost import AT, begun

STEPS = 120
NONE_IN_CONTACT = "no factor while in contact"
UNCORRECTED = "factor, not corrected"
WAYS = (FACTOR, UNCORRECTED, NONE_IN_CONTACT, FIRST, JACOBI)
KIND = KINDS.enumeration("Kind")


def _solver(way: str, tets: int) -> dict[str, Any]:
    """woodbury = 0: a factor is not corrected for what came after its matrix."""
    known = solvers(tets)
    return known.get(way, known[FACTOR]) | ({"woodbury": 0} if way == UNCORRECTED else {})


def curves(tets: int, device: str = "cpu", steps: int = STEPS) -> list[Row]:
    """Iterations and time of each step; the impact has `AT` steps from `first` on."""
    found = []
    for way in WAYS:
        sim = replace(IMPACT, steps=steps).simulation(tets, _solver(way, tets), device=device)
        driver = begun(sim)
        records = _by_turns(driver, steps) if way == NONE_IN_CONTACT else driver.advance(steps)
        found.append({
            "device": device, "tets": tets, "preconditioner": way, "first": int(np.argmax(records["passes"] > 0)),
            "step": records["step"].tolist(), "iterations": records["iterations"].tolist(),
            "passes": records["passes"].tolist(), "ms": times(records, device).tolist(),
        })  # fmt: skip
    return found


def _by_turns(driver: Driver, steps: int) -> Any:
    """Block Jacobi from the step after the one that touched something until one that touches nothing."""
    records, settings = [], driver.engine.settings(0)
    usual = settings.kind
    for _ in range(steps):
        records.append(driver.advance(1))
        settings.kind = KIND["BLOCK_JACOBI"] if records[-1]["passes"].any() else usual
    return np.concatenate(records)


def phases(row: Row) -> list[Row]:
    """A line for before, at and after the impact."""
    first, found = row["first"], []
    parts = {"before": slice(0, first), "at": slice(first, first + AT), "after": slice(first + AT, None)}
    for phase, part in parts.items():
        iterations, ms = (np.array(row[name][part], dtype=float) for name in ("iterations", "ms"))
        if len(ms):
            found.append({
                "impact": phase, "preconditioner": row["preconditioner"], "steps": len(ms),
                "iterations": float(iterations.mean()), "most": int(iterations.max()), **of_times(ms),
            })  # fmt: skip
    return found
