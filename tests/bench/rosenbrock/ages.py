# SPDX-License-Identifier: MIT
"""What the age of a factor, its precision and the warp do to the error of a step by the factor alone."""

import numpy as np

from tests.bench.rosenbrock.bars import (
    EULER,
    LENGTH,
    REFERENCE,
    REFERENCE_STEP,
    ROS2_FACTOR,
    ROS2_ITERATE,
    Bar,
    Method,
    Row,
    Run,
    run,
)

LATENCIES = (1, 3, 10, 30, 100)
TIME_STEPS = (0.005, 0.01, 0.02, 0.04)  # s
KINDS = {  # of the factor by device: its usual precision, a finer one, and without the warp
    "cpu": {"warped": {}, "warped, float64": {"factor_precision": "float64"}, "not warped": {"warp": False}},
    "gpu": {"warped": {}, "warped, float32": {"factor_precision": "float32"}, "not warped": {"warp": False}},
}


def rows(bar: Bar, device: str, seconds: float, steps: tuple[float, ...], latencies: tuple[int, ...]) -> list[Row]:
    """All ages, precisions and time steps, beside backward Euler and the iterating form."""
    reference = run(bar, REFERENCE, REFERENCE_STEP, seconds, device)
    found: list[Row] = []
    for dt in steps:
        for method in (EULER, ROS2_ITERATE):
            found.append(_row(run(bar, method, dt, seconds, device), reference, method.name, None))
        for name, solver in KINDS[device].items():
            for latency in latencies:
                method = Method(name, ROS2_FACTOR.integrator, solver, latency)
                found.append(_row(run(bar, method, dt, seconds, device), reference, name, latency))
    return [{"device": device, **row} for row in found]


def _row(one: Run, reference: Run, name: str, latency: int | None) -> Row:
    r = one.records
    used = r["factor_step"] >= 0
    estimate = r["estimate"][np.isfinite(r["estimate"])] / LENGTH
    return {
        "matrix": name, "latency": latency or 0, "dt ms": 1e3 * one.dt,
        "mean age": float((r["step"] - 1 - r["factor_step"])[used].mean()) if used.any() else 0.0,
        "error / L": one.error(reference), "by factor": one.share("FACTOR"), "euler": one.share("EULER"),
        "estimate / L": float(np.median(estimate)) if len(estimate) else None,
        "largest estimate / L": float(estimate.max()) if len(estimate) else None,
    }  # fmt: skip
