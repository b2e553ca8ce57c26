# SPDX-License-Identifier: MIT
"""The page of the fault benchmark: the table with its penalties, memory, what was skipped; of one run or several."""

from typing import Any

from tests.bench.harness.report import Report
from tests.support.stage import DT

Row = dict[str, Any]
QUIET_THERE = "quiet, over a network"
WHAT = {
    "quiet": "nothing",
    "kill": "kill -9 of the worker, another is started",
    "stop": "SIGSTOP of the worker for 5 s",
    "storm": "kill -9 and a new worker every few seconds",
    "sleeper": "a client that subscribes and sleeps",
    "flood": "garbage on all channels of workers",
    QUIET_THERE: "nothing; the worker gets bytes through a cable",
    "cut": "network between server and worker cut",
}
THERE = (QUIET_THERE, "cut")
COLUMNS = (
    "what", "steps", "missed", "not converged", "step p50 ms", "step max ms", "step CPU max ms", "latest start ms",
    "late steps", "iterations", "iterations, times quiet", "oldest factor", "next factor s",
    "messages refused", "workers killed",
)  # fmt: skip
SETTING = (
    f"A beam of 1152 tetrahedra in real time, dt {1e3 * DT:g} ms. missed: steps that the log does not hold; CPU: "
    "processor time of the loop's thread, so that a step that waited for a core shows; latest "
    "start: the largest delay of a step after its time; late steps: by more than 1 ms; next factor: from the end of "
    "the fault to the first step with a factor made after it. Iterations of steps with a factor."
)
SUMS = ("steps", "missed", "not converged", "late steps", "messages refused", "workers killed")
LARGEST = (
    "step p50 ms", "step max ms", "step CPU max ms", "latest start ms", "iterations max", "oldest factor",
    "next factor s",
)  # fmt: skip


def write(report: Report, rows: list[Row], lives: list[Row], skipped: dict[str, str]) -> None:
    """Page and JSON."""
    report.data.update(rows=rows, lives=lives, skipped=skipped)
    report.remember(rows, ("server", "workers on", "fault"), ("missed", "late steps", "iterations"))
    report.say(SETTING)
    for pair in dict.fromkeys((r["server"], r["workers on"]) for r in rows):
        mine = [r for r in rows if (r["server"], r["workers on"]) == pair]
        report.say(f"## Server on a {pair[0].upper()}, workers on a {pair[1].upper()}")
        report.table(with_penalties(mine), COLUMNS)
    if lives:
        report.say("## Memory", "Workers killed with -9 one after another, each after its first factor.")
        report.table(lives)
    for name, why in skipped.items():
        report.say(f"Skipped: {WHAT[name]}: {why}")
    report.write()


def with_penalties(rows: list[Row]) -> list[Row]:
    """Iterations against the quiet run of the same network."""
    base = {name: next((r["iterations"] for r in rows if r["fault"] == name), None) for name in ("quiet", QUIET_THERE)}
    out = []
    for row in rows:
        quiet = base[QUIET_THERE if row["fault"] in THERE else "quiet"]
        out.append({**row, "what": WHAT[row["fault"]], "iterations, times quiet": quiet and row["iterations"] / quiet})
    return out


def merged(parts: list[Row]) -> tuple[list[Row], list[Row], dict[str, str]]:
    """Of several runs: storms are added up, of everything else the latest counts. skipped: what no run has."""
    rows: dict[tuple[str, ...], Row] = {}
    lives: dict[tuple[str, ...], list[Row]] = {}
    skipped: dict[str, str] = {}
    for part in parts:
        skipped |= part.get("skipped", {})
        for row in part.get("rows", []):
            key = (row["server"], row["workers on"], row["fault"])
            rows[key] = added(rows[key], row) if row["fault"] == "storm" and key in rows else row
        if part.get("lives"):
            lives[part["lives"][0]["server"], part["lives"][0]["workers on"]] = part["lives"]
    order = list(WHAT)
    found = sorted(rows.values(), key=lambda r: (r["server"], r["workers on"], order.index(r["fault"])))
    have = {row["fault"] for row in found}
    flat = [row for group in lives.values() for row in group]
    return found, flat, {name: why for name, why in skipped.items() if name not in have}


def added(one: Row, other: Row) -> Row:
    """Two storms as if they were one. The median of a step: the larger of both."""
    out = {**other, **{name: one[name] + other[name] for name in SUMS}}
    for name in LARGEST:
        out[name] = max((r[name] for r in (one, other) if r[name] is not None), default=None)
    total = one["iterations"] * one["steps"] + other["iterations"] * other["steps"]
    return {**out, "iterations": total / out["steps"]}
