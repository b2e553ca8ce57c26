# SPDX-License-Identifier: MIT
"""The verdict of a load test in one line: whether steps keep pace with the clock, the share of late ones, the limit."""

from __future__ import annotations

from typing import Any

import numpy as np

from clients.log.scalars import Columns
from protocol import messages_pb2 as pb

MIN_RATE = 0.98  # s simulated per second; below, steps do not keep pace
MAX_RATE = 1.05  # s simulated per second; above, the server does not follow the clock
FEW_LATE = 0.01  # share of late steps up to which no reason is given
MIN_CORE_SHARE = 0.7  # processor time over time of a step; below, the loop waited for a core


def verdict(ended: pb.Status, steps: dict[str, Any], seconds: float, bodies: dict[str, Columns]) -> str:
    """Words the verdict. ended: status at the end; steps: as in the report; bodies: scalars of these steps, by body."""
    if not steps["count"]:
        return f"no verdict: no step was made ({ended.state})"
    if steps["ms_p50"] is None:
        return "no verdict: no record of a step came"
    rate, late = steps["count"] * ended.dt / seconds, steps["late"] / steps["count"]
    times = f"a step takes {steps['ms_p50']:.3g} ms (p50), {steps['ms_p99']:.3g} ms (p99), dt is {1e3 * ended.dt:g} ms"
    if rate > MAX_RATE:
        return f"not in real time: {rate:.3g} s simulated a second; {times}"
    shown = f"{100 * late:.2g} % of {steps['count']} steps late"
    if rate >= MIN_RATE and late <= FEW_LATE:
        return f"keeps pace: {shown}; {times}"
    begun = (
        f"keeps pace: {shown}" if rate >= MIN_RATE else f"does not keep pace: {rate:.2g} s simulated a second, {shown}"
    )
    found = [columns for columns in bodies.values() if len(columns["step"])]
    return f"{begun}; {times}; what limits: {limit(found, ended.dt, ended.device == 'gpu', len(ended.workers))}"


def limit(bodies: list[Columns], dt: float, on_gpu: bool, workers: int) -> str:
    """Names what takes most of the time of a step, or what steps wait for."""
    whole = bodies[0]["step_seconds"]
    core = bodies[0]["cpu_seconds"].sum() / whole.sum()
    if not on_gpu and core < MIN_CORE_SHARE:
        return f"a core, which the loop had for {100 * core:.0f} % of its steps"
    if np.median(whole) < dt / 2:
        return "few steps that take long"
    solve = _solve(bodies, on_gpu) / whole.sum()
    if solve < 0.5:
        return f"assembly, {100 * (1 - solve):.0f} % of a step"
    iterations = np.concatenate([columns["iterations"] for columns in bodies]).mean()
    helped = "" if workers else ", no workers"
    return f"the solve, {100 * solve:.0f} % of a step, {iterations:.3g} iterations a body{helped}"


def _solve(bodies: list[Columns], on_gpu: bool) -> float:
    """Sum of the solve times [s]; bodies may be solved in parallel. On a GPU only the solve is timed."""
    if on_gpu:
        return max(float(columns["solve_seconds"].sum()) for columns in bodies)
    others = bodies[0]["assemble_seconds"] + bodies[0]["integrate_seconds"]
    return float((bodies[0]["step_seconds"] - others).sum())
