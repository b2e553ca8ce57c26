# SPDX-License-Identifier: MIT
"""Points of work against precision: a scene under some settings, its errors and what a simulated second costs."""

from typing import Any

import numpy as np

from tests.bench.accuracy.axes import MESH, SCHEMES, Point
from tests.bench.accuracy.cases import Case, Settings, usual
from tests.bench.accuracy.motion import Motion, Reference, error, exact_solve, exact_step, move, reference, rms
from tests.bench.accuracy.sources import CELLS, on_mesh

Row = dict[str, Any]
OTHER_STEP = ("dt", "integrator.scheme")  # keys that make other steps than those of exact_step
OTHER_SOLVE = ("integrator.linearizations", "accuracy.position")  # or other linear systems than those of one solve
STATISTICS = (("p50", 50), ("p99", 99), ("max", 100))


def rows(case: Case, points: list[Point], device: str, rounds: int) -> list[Row]:
    """Of an axis."""
    return [
        {"device": device, "scene": case.name, "axis": p.axis, "series": p.series, "value": p.value}
        | measured(case, p.settings, device, rounds, reference(case, p.truth), against_steps=p.truth is None)
        for p in points
    ]


def of_meshes(case: Case, device: str, rounds: int) -> list[Row]:
    """Of the axis mesh: each beside the finest one, at the nodes that both have."""
    finest = on_mesh(case, (CELLS[-1], CELLS[-1], 4 * CELLS[-1]))
    true, found = Reference(finest, reference(case).apart, {}), []
    for series in ("backward Euler", "Newmark, 3 linearizations"):
        for n in CELLS[:-1]:
            settings = usual(SCHEMES[series], case.meshed((n, n, 4 * n)))
            names = {
                "device": device,
                "scene": case.name,
                "axis": MESH,
                "series": series,
                "value": f"{6 * 4 * n**3} tets",
            }
            found.append(names | measured(case, settings, device, rounds, true, against_steps=False))
    return found


def measured(
    case: Case, settings: Settings, device: str, rounds: int, true: Reference, against_steps: bool = True
) -> Row:
    """One point. settings: as `sim-server --set KEY=VALUE` takes them.

    error, rms [m] are against the motion that small steps make, of which `apart` [m] is known; step error [m] is
    against that of the same steps solved exactly, solve error [m] against that of one linearization with exact linear
    solves (None for another scheme or time step than the scene's, the latter for several linearizations, too).
    seconds: of a simulated second, the median over rounds; step_ms: of a step, each the median over rounds. What ran
    away has its time until then; what failed has none.
    """
    runs = [move(case, settings, device) for _ in range(rounds)]
    last = runs[-1]
    timed = [run for run in runs if len(run.records) > 1]
    whole = [seconds(run) for run in timed]
    same_step = against_steps and not any(key in settings for key in OTHER_STEP)
    one_solve = same_step and not any(key in settings for key in OTHER_SOLVE)
    return {
        "settings": dict(settings), "status": last.status, "reason": last.reason,
        "error": error(last, true.motion), "rms": rms(last, true.motion), "apart": true.apart,
        "step error": error(last, exact_step(case, {})) if same_step else None,
        "solve error": error(last, exact_solve(case)) if one_solve else None, "length": case.length,
        "seconds": float(np.median(whole)) if timed else None, "rounds": whole,
        "step_ms": {name: _percentile(timed, q) for name, q in STATISTICS},
        "iterations": _mean(last, "iterations"), "linearizations": _mean(last, "linearizations"),
        "unconverged": last.unconverged if timed else None, "tets": last.tets,
    }  # fmt: skip


def seconds(run: Motion) -> float:
    """Of a simulated second, by the mean of a step."""
    steps = len(run.records) / (len(run.frames) * run.interval)
    return 1e-3 * float(run.milliseconds.mean()) * steps


def _percentile(runs: list[Motion], q: float) -> float | None:
    return float(np.median([np.percentile(run.milliseconds, q) for run in runs])) if runs else None


def _mean(run: Motion, name: str) -> float | None:
    return float(run.records[name].mean()) if len(run.records) else None
