# SPDX-License-Identifier: MIT
"""The page: a row for each aim, and tables of all that was measured."""

from collections.abc import Sequence
from typing import Any

from tests.bench.harness.report import Report
from tests.bench.speed.targets import TARGETS, Target

Row = dict[str, Any]
KEYS = ("what", "tets", "material", "beams", "threads", "settings", "side")


def of_runs(parts: Sequence[Row]) -> None:
    """Has all rows of the runs that a page is put together of tell the number of theirs."""
    for number, part in enumerate(parts, 1):
        part["data"]["rows"] = [{**row, "run": number} for row in part["data"].get("rows", [])]


def of(rows: Sequence[Row], where: Row, side: str) -> Row | None:
    """The row of a side that a target means."""
    wanted = {"side": side, "settings": None, **where}
    return next((row for row in rows if all(row.get(k) == v for k, v in wanted.items())), None)


def _told(row: Row | None, target: Target) -> str:
    """Its figures: of times p50 / p99 / max."""
    if row is None or row.get(target.column) is None:
        return "–"
    columns = ("p50", "p99", "max") if target.column in ("p50", "p99") else (target.column,)
    return " / ".join(_number(row[column]) for column in columns)


def _times(gain: float | None) -> str:
    return "–" if gain is None else f"{_number(gain)} x"


def _measured(before: Row | None, after: Row | None, target: Target) -> float | None:
    """The gain of two rows of one run; None if they are of two: machines differ, and one is not always as fast."""
    if before is None or after is None or before.get("run") != after.get("run"):
        return None
    return target.gain(before.get(target.column), after.get(target.column))


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


def summary(rows: Sequence[Row]) -> list[Row]:
    """A row for each target that was measured on a side."""
    out = []
    for target in TARGETS:
        before, after = (of(rows, target.where, side) for side in ("before", "after"))
        if before is None and after is None:
            continue
        value = after.get(target.column) if after else None
        out.append(
            {"what": target.what, "before": _told(before, target), "now": _told(after, target), "unit": target.unit,
             "goal": target.goal_text(), "met": target.met(value),
             "gain": _times(_measured(before, after, target)),
             "gain aimed at": _times(target.gain(target.was, target.goal)), "what bounds it": target.bound}
        )  # fmt: skip
    return out


TABLES = (
    (
        "threads",
        "One body on the threads of a CPU",
        "SOFA's beam (below) on `[solver] threads`: turns of 8 steps with a factor of their first matrix, the same "
        "for both; wall ms of steps. GB/s of L: bytes of the factor that its solves read, twice an iteration, over "
        "the time of the whole solve.",
    ),
    (
        "sofa",
        "SOFA's beam",
        "1 x 1 x 4 m, E 3 MPa, Poisson 0.3, Rayleigh 0.1 / 0.1, dt 20 ms, equal masses, tolerance 1e-6 of the true "
        "residual, one thread and a worker process, as fast as it goes. p50, p99, max: ms of the loop's processor "
        "time; wall: of whole steps. The goal is what was measured for SOFA v17.06 with the logic of its "
        "asynchronous solver, the same mesh, matrix and stop rule, on another machine (2.5 GHz Cascade Lake, dgemm "
        "1000 in 35 ms on one thread; here: above).",
    ),
    (
        "steps",
        "Steps on a GPU",
        "The beams of [the page of the GPU](gpu.md) with factors 1 to 16 steps old, which are made between the "
        "rounds; ms of single steps on the device, of all beams together. Factor ms, in use ms: to make all "
        "factors of a round, and to hand them over; below 24,000 tetrahedra a CPU makes them, before by SuperLU where "
        "CHOLMOD is not installed. Host us: processor time of the thread that launches a step.",
    ),
    (
        "real_time",
        "A server in real time",
        "With one worker process on the same device, dt 30 ms. In use: from the first answer until a step used a "
        "factor. In the second half of the run: factors a second, their age in steps, ms from the beginning of the "
        "step whose matrix is factorized to that of the first step with its factor (in whole steps), ms of steps. "
        "Answers: to status queries.",
    ),
    (
        "many",
        "A server of many small bodies",
        "As fast as it goes, one worker process on the same device, measured by its statuses after each body has "
        "had two factors (ready; or ten seconds): beams that come to rest meanwhile. Without: bodies that had none. "
        "Ages: of factors at each look. Host us: processor time of the loop's thread for a "
        "step, with what it does for the factors that come in.",
    ),
    (
        "swinging",
        "Many small bodies that keep swinging",
        "In one process, as fast as they go, with one worker process: each is put back to its start every 100 steps "
        "(`python -m tests.bench.gpu.many_factors`). Ages: of the factors of all steps.",
    ),
    (
        "motion",
        "To an error of 2e-3 of the length",
        "3,000 tetrahedra of stable Neo-Hookean material, E 1 MPa, Poisson 0.45, no damping, dt 20 ms, two "
        "linearizations, solves to 1e-3, a factor each 3 steps. Error: largest distance of a node over 1.2 s from "
        "the same scheme with each step solved exactly, over the length. The goal is what was measured for Newton "
        "1.8.0's SolverVBD on an H200 in the same way: 300 iterations, 11.4 ms, for 2.3e-3 (10 iterations: 0.39 "
        "ms, 0.55).",
    ),
)


def write(report: Report, rows: list[Row]) -> None:
    """Everything."""
    report.data["rows"] = rows
    report.say(
        "Before and now in one run on the same machine: two processes, one of each checkout, that take turns "
        "(servers: one after the other). Times are p50 / p99 / max of single steps. A goal is compared with the "
        "median, or with what the row names. On which machine a row was measured, and in which run, stands in the "
        "tables below.",
        "Goals are figures of other machines: of a GPU an H200, whose memory has 1.43 times the bandwidth of an "
        "H100's (4.8 and 3.35 TB/s by its maker), of a CPU two EPYC cores. So *gain*, before over now where one run "
        "measured both, stands beside *gain aimed at*: what the commit before took on the machine of the goal, over "
        "the goal. The last one is the aim that does not depend on the machine, as far as the same thing bounds it.",
    )
    if aims := summary(rows):
        report.say("## All of it")
        report.table(aims)
    for what, title, words in TABLES:
        mine = [{k: v for k, v in row.items() if k != "what"} for row in rows if row["what"] == what]
        if mine:
            report.say(f"## {title}", words)
            report.table(mine, list(dict.fromkeys(key for row in mine for key in row)))
    report.write()
