# SPDX-License-Identifier: MIT
"""The first line of a load test."""

import numpy as np
import pytest

from clients.load_test.verdict import verdict
from clients.log.scalars import Columns
from protocol import messages_pb2 as pb

DT, COUNT = 0.02, 500


def said(
    ms: float, late: int = 0, seconds: float = COUNT * DT, assembly: float = 0.2, core: float = 1.0,
    device: str = "cpu", workers: int = 1, longest: float | None = None,
) -> str:  # fmt: skip
    """Of 500 steps of two bodies; assembly, core: shares of the time of a step."""
    whole = np.full(COUNT, ms * 1e-3)
    whole[:20] = (longest or ms) * 1e-3
    body: Columns = {
        "step": np.arange(COUNT), "step_seconds": whole, "cpu_seconds": core * whole, "iterations": np.full(COUNT, 7),
        "assemble_seconds": 0.75 * assembly * whole, "integrate_seconds": 0.25 * assembly * whole,
        "solve_seconds": (1 - assembly) * whole,
    }  # fmt: skip
    if device == "gpu":
        body |= {"assemble_seconds": 0 * whole, "integrate_seconds": 0 * whole}
    ended = pb.Status(dt=DT, device=device, workers=[pb.WorkerInfo()] * workers, state="running")
    p50, p99 = 1e3 * np.percentile(whole, [50, 99])
    steps = {"count": COUNT, "late": late, "ms_p50": p50, "ms_p99": p99}
    return verdict(ended, steps, seconds, {"a": body, "b": dict(body), "unseen": {n: v[:0] for n, v in body.items()}})


def test_a_server_that_keeps_pace():
    assert said(4) == "keeps pace: 0 % of 500 steps late; a step takes 4 ms (p50), 4 ms (p99), dt is 20 ms"
    assert said(4, late=4).startswith("keeps pace: 0.8 % of 500 steps late; ") and "limits" not in said(4, late=4)


@pytest.mark.parametrize(
    ("case", "limit"),
    [
        ({}, "the solve, 80 % of a step, 7 iterations a body"),
        ({"workers": 0}, "the solve, 80 % of a step, 7 iterations a body, no workers"),
        ({"assembly": 0.6}, "assembly, 60 % of a step"),
        ({"core": 0.5}, "a core, which the loop had for 50 % of its steps"),
        ({"device": "gpu", "core": 0.01, "assembly": 0.1}, "the solve, 90 % of a step, 7 iterations a body"),
    ],
)
def test_one_that_does_not_names_what_limits(case, limit):
    line = said(40, late=450, seconds=COUNT * 0.04, **case)
    begun = "does not keep pace: 0.5 s simulated a second, 90 % of 500 steps late"
    assert line == f"{begun}; a step takes 40 ms (p50), 40 ms (p99), dt is 20 ms; what limits: {limit}"


def test_steps_that_are_late_now_and_then():
    line = said(4, late=20, longest=70)
    assert line.startswith("keeps pace: 4 % of 500 steps late; ") and line.endswith("limits: few steps that take long")


def test_a_server_that_does_not_go_by_the_clock():
    assert said(4, seconds=2.0).startswith("not in real time: 5 s simulated a second; a step takes 4 ms (p50)")


def test_without_steps_there_is_no_verdict():
    ended = pb.Status(dt=DT, state="paused")
    assert verdict(ended, {"count": 0, "late": 0, "ms_p50": None}, 1.0, {}) == "no verdict: no step was made (paused)"
    assert verdict(ended, {"count": 9, "late": 0, "ms_p50": None}, 1.0, {}).startswith("no verdict: no record")
