# SPDX-License-Identifier: MIT
"""What a step costs in its forms, and where the method is at its limits."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.bench.rosenbrock.bars import (
    EULER,
    FRAME,
    REFERENCE,
    REFERENCE_STEP,
    ROS2_FACTOR,
    ROS2_ITERATE,
    STARTS,
    Bar,
    Row,
    Run,
    run,
)

DT = 0.02  # s
METHODS = (EULER, ROS2_ITERATE, ROS2_FACTOR)
LIMITS: dict[str, tuple[Bar, float, str]] = {  # by what is varied: bar, dt, start
    "base case: E 1 MPa, 20 ms": (Bar(), 0.02, "let go"),
    "dt 40 ms": (Bar(), 0.04, "let go"),
    "dt 80 ms": (Bar(), 0.08, "let go"),
    "3000 tetrahedra, E 0.1 MPa, dt 40 ms": (Bar(3000, 1e5), 0.04, "let go"),
    "damping of the stiffness 0.01 s": (Bar(beta=0.01), 0.02, "let go"),
    "damping of the stiffness 0.05 s": (Bar(beta=0.05), 0.02, "let go"),
    "damping of the stiffness 0.2 s": (Bar(beta=0.2), 0.02, "let go"),
    "Poisson's ratio 0.499": (Bar(poisson=0.499), 0.02, "let go"),
    "mass_spring": (Bar(model="mass_spring"), 0.02, "let go"),
    "stable_neo_hookean": (Bar(model="stable_neo_hookean"), 0.02, "let go"),
    "stretched to three times its length": (Bar(gravity=False, damping=1.0), 0.02, "stretched"),
    "spun at 20 rad/s": (Bar(gravity=False, damping=1.0), 0.02, "spun"),
    "Poisson's ratio 0.499, usual tangent": (Bar(poisson=0.499, tangent="usual"), 0.02, "let go"),
    "162 tetrahedra": (Bar(162), 0.02, "let go"),
}


def rows(bar: Bar, device: str, steps: int) -> list[Row]:
    """Step times of one size, factors 10 to 19 steps old; steps whose matrix is copied for a factor stand apart."""
    found: list[Row] = []
    for method in METHODS:
        one = run(bar, method, DT, steps * DT, device, frames=False)
        times, copied = one.step_times(), _copied(one)[1:]
        parts = {n: 1e3 * float(np.median(one.records[n][1:][~copied])) for n in ("assemble", "solve", "integrate")}
        found.append({
            "device": device, "tets": bar.tets, "material": bar.material, "method": method.name,
            "p50 ms": float(np.median(times)), "p99 ms": float(np.percentile(times, 99)),
            "most ms": float(times.max()), "p99 / p50": float(np.percentile(times, 99) / np.median(times)),
            "p50 of steps that copy a matrix": float(np.median(times[copied])), **parts,
            "iterations": one.iterations, "by factor": one.share("FACTOR"),
        })  # fmt: skip
    return found


def _copied(one: Run) -> NDArray[np.bool_]:
    """Steps whose matrix was copied for a factor: with lockstep-D the second of a run and each D-th from there."""
    return np.arange(len(one.records)) % EULER.latency == 1


def limits(name: str, device: str, seconds: float, tets: int = 0) -> list[Row]:
    """Error and cost of a row of LIMITS. tets: another size, for a smoke run."""
    bar, dt, start = LIMITS[name]
    bar = replace(bar, tets=tets) if tets else bar
    change = STARTS[start][1]
    seconds = round(seconds / max(dt, FRAME)) * max(dt, FRAME)
    reference = run(bar, REFERENCE, REFERENCE_STEP, seconds, device, change)
    if dt > FRAME:
        reference.frames = reference.frames[round(dt / FRAME) - 1 :: round(dt / FRAME)]
    found: Row = {"device": device, "case": name}
    euler, iterate, factor = (run(bar, method, dt, seconds, device, change) for method in METHODS)
    named = {"Euler": euler, "iterate": iterate, "factor": factor}
    found |= {f"{title}: error / L": one.error(reference) for title, one in named.items()}
    found |= {f"{title}: ms / s": one.cost() for title, one in named.items()}
    found |= {"factor / Euler": factor.cost() / euler.cost(), "by factor": factor.share("FACTOR")}
    found |= {"by iterations": factor.share("ITERATE"), "by Euler": factor.share("EULER")}
    return [found]
