# SPDX-License-Identifier: MIT
"""How many servers, workers and users fit together: a model of capacity, and 1,000 servers simulated."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.harness.report import Report
from tests.bench.scale import capacity, page
from tests.bench.scale.policies import POLICIES
from tests.bench.scale.simulate import LINK, Plan, Run, quantiles

TITLE = "Towards thousands of servers"
QUICK = Plan(servers=40, workers=8, pools=2, racks=2, warm=2.0, seconds=8.0, touched=0.4)
RACK = {"warm": 30.0, "lost": 40.0, "seconds": 80.0, "away": 20.0}
QUICK_RACK = {"warm": 2.0, "lost": 4.0, "seconds": 12.0, "away": 4.0}


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def figures(run: Run, what: str) -> dict[str, Any]:
    """A row: what one run found."""
    plan, span = run.plan, run.plan.seconds - run.plan.warm
    losses = [lost for _, lost, _ in run.samples]
    held, rest = (quantiles(run.ages[touched], (0.5, 0.99)) for touched in (True, False))
    return {
        "what": what, "choice": plan.policy, "age p50 s": held[0], "age p99 s": held[1],
        "resting: age p50 s": rest[0], "resting: age p99 s": rest[1],
        "lost ms/s": 1e3 * mean(losses),
        "lost p99 ms/s": 1e3 * float(np.quantile(losses, 0.99)) if losses else 0.0,
        "late %": 100 * mean([float(late) for _, _, late in run.samples]), "factors/s": run.factors / span,
        "changes a worker and minute": 60 * run.changes / span / plan.workers,
        "workers busy %": 100 * mean([worker.worked / span for worker in run.workers]),
        "busiest router %": 100 * max(run.carried) / (span * plan.link),
    }  # fmt: skip


def lost_in(run: Run, begin: float, end: float) -> float:
    """Mean time that a body in a hand loses [ms/s]."""
    return 1e3 * mean([lost for time, lost, _ in run.samples if begin <= time < end])


def back_after(run: Run, since: float, goal: float, end: float) -> float | None:
    """Seconds from a time until bodies lose as little as before, over 2 s; None if they do not before the end."""
    time = since
    while time + 2 <= end:
        if lost_in(run, time, time + 2) <= goal:
            return time + 2 - since
        time += 0.5
    return None


def rack(run: Run, what: str) -> dict[str, Any]:
    """A row: a rack of workers that is lost and comes back."""
    lost, back, end = run.plan.lost or 0.0, (run.plan.lost or 0.0) + run.plan.away, run.plan.seconds
    before = lost_in(run, run.plan.warm, lost)
    return {
        "workers": what, "choice": run.plan.policy, "lost ms/s before": before,
        "while it is away": lost_in(run, lost, back), "the last 5 s of that": lost_in(run, back - 5, back),
        "5 s and more after": lost_in(run, min(back + 5, end - 1), end),
        "back to 1.2 times s": back_after(run, back, 1.2 * before, end),
    }  # fmt: skip


def simulated(base: Plan, racked: dict[str, Any], quick: bool) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Runs all plans; returns the rows of both tables."""
    plans = [(f"{base.pools} pools", replace(base, policy=policy)) for policy in POLICIES]
    plans += [
        ("one pool", replace(base, pools=1)),
        ("half as many workers, pools twice as large",
         replace(base, workers=base.workers // 2, pools=max(base.pools // 2, 1))),
        ("twice as many workers", replace(base, workers=2 * base.workers)),
        ("links ten times as fast", replace(base, link=10 * LINK)),
        ("five times as many hands", replace(base, touched=5 * base.touched)),
    ]  # fmt: skip
    rows, racks = [], []
    for what, plan in plans[: len(POLICIES) + 1] if quick else plans:
        rows.append(figures(Run(plan).run(), what))
        print(rows[-1], flush=True)
    for what, policy, spread in (
        ("of each pool in all racks", "need", True), ("of each pool in all racks", "fixed", True),
        ("of a pool in one rack", "need", False),
    ):  # fmt: skip
        racks.append(rack(Run(replace(base, policy=policy, spread=spread, **racked)).run(), what))
        print(racks[-1], flush=True)
    return rows, racks


def main() -> None:
    parser = argparse.ArgumentParser(prog="deploy/run bench scale", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run of few servers")
    parser.add_argument("--out", type=Path, help="folder for the results (default: out/bench/scale)")
    parser.add_argument("--seed", type=int, default=0, help="of the simulation: the same one gives the same figures")
    options = parser.parse_args()
    base = replace(QUICK if options.quick else Plan(), seed=options.seed)
    arguments = {"servers": base.servers, "workers": base.workers, "pools": base.pools, "racks": base.racks,
                 "seed": base.seed}  # fmt: skip
    report = Report("scale", TITLE, arguments, options.out, options.quick)
    rows, racks = simulated(base, QUICK_RACK if options.quick else RACK, options.quick)
    page.fill(report, base, rows, racks, capacity, quick=options.quick)
    report.remember(rows, ("what", "choice"), ("age p99 s", "lost ms/s"))
    report.write()


if __name__ == "__main__":
    main()
