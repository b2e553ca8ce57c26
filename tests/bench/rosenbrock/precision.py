# SPDX-License-Identifier: MIT
"""Work against precision: error of the motion and milliseconds a simulated second, by method and time step."""

from itertools import pairwise

import numpy as np

from tests.bench.rosenbrock.bars import (
    OTHERS,
    REFERENCE,
    REFERENCE_STEP,
    ROS2_FACTOR,
    SECOND_REFERENCE,
    Bar,
    Method,
    Row,
    run,
)

OURS = ROS2_FACTOR.aged(10)
METHODS = (*OTHERS, OURS, ROS2_FACTOR.aged(3))
LARGE = 24_000  # tetrahedra from which on there are fewer methods and time steps, and shorter runs
TIME_STEPS = (0.04, 0.02, 0.01, 0.005, 0.0025)  # s
FLOOR = 3.0  # times the distance of the references: errors below it are not compared
ERRORS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)  # of L


def methods_for(tets: int) -> tuple[Method, ...]:
    """Those that a size is measured with: without those that smaller ones show to be beaten by their likes."""
    beaten = ("3 linearizations", "bdf2, 2", "newmark, 1e-6") if tets > 540 else ()
    beaten = (*beaten, "1e-6", "3 to 5") if tets >= LARGE else beaten
    return tuple(m for m in METHODS if not any(word in m.name for word in beaten))


def rows(
    bar: Bar, device: str, seconds: float, steps: tuple[float, ...], methods: tuple[Method, ...], rounds: int = 1
) -> list[Row]:
    """Of one bar. rounds: how often each run is made; of each of its steps the least time counts."""
    reference = run(bar, REFERENCE, REFERENCE_STEP, seconds, device)
    apart = run(bar, SECOND_REFERENCE, 2 * REFERENCE_STEP, seconds, device).error(reference)
    found: list[Row] = []
    for method in methods:
        for dt in steps:
            one = run(bar, method, dt, seconds, device)
            again = [run(bar, method, dt, seconds, device, frames=False).step_times() for _ in range(rounds - 1)]
            cost = float(np.minimum.reduce([one.step_times(), *again]).mean()) / dt
            found.append({
                "device": device, "tets": bar.tets, "material": bar.material, "E MPa": bar.young / 1e6,
                "method": method.name, "dt ms": 1e3 * dt, "error / L": one.error(reference), "ms / s": cost,
                "iterations": one.iterations, "by factor": one.share("FACTOR"), "apart": apart, "seconds": seconds,
            })  # fmt: skip
    return found


def cost_at(points: list[Row], error: float) -> float:
    """Milliseconds a simulated second of the cheapest time step of a method with this error or less.

    Between two measured steps: logarithms of cost and error on straight lines. nan: no step is exact enough.
    """
    known = [p for p in points if p["error / L"] is not None and np.isfinite(p["error / L"])]
    line = [(p["error / L"], p["ms / s"]) for p in sorted(known, key=lambda p: p["dt ms"])]
    costs = [cost for e, cost in line if e <= error]
    for (e1, c1), (e2, c2) in pairwise(line):
        if (e1 - error) * (e2 - error) < 0:
            t = np.log(error / e1) / np.log(e2 / e1)
            costs.append(float(c1 * (c2 / c1) ** t))
    return min(costs, default=float("nan"))


def cheapest(points: list[Row]) -> list[Row]:
    """For each error what every method costs, and the cheapest other method over OURS. points: of one bar."""
    names = list(dict.fromkeys(p["method"] for p in points))
    found: list[Row] = []
    apart = points[0]["apart"]
    for error in ERRORS:
        if apart is None or not error >= FLOOR * apart:
            continue
        costs = {n: cost_at([p for p in points if p["method"] == n], error) for n in names}
        others = {n: c for n, c in costs.items() if not n.startswith("ros2") and np.isfinite(c)}
        best = min(others, key=lambda n: others[n], default="none")
        ratio = others[best] / costs[OURS.name] if others and OURS.name in costs else float("nan")
        found.append({"error / L": f"{error:.0e}", **costs, "best other": best, "best other / ros2": ratio})
    return found
