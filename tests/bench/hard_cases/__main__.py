# SPDX-License-Identifier: MIT
"""Runs the tables of hard cases (tests/hard_cases: table.py, effect_table.py, models.py, seeds.py, long_runs.py).

In pieces: --only, --device and --precision say which, --jobs in how many processes, --limit for how long; each leaves
hard_cases.json. --merge makes one page of such files. All of a GPU: --device gpu --precision float64 --precision mixed
--precision float32 --jobs 16.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # cases are small, and run beside each other

import json
from pathlib import Path
from typing import Annotated

import typer

from tests.bench.hard_cases.measuring import ROUNDING, TABLES, Job, Row, run_all
from tests.bench.hard_cases.page import write_page
from tests.bench.harness.report import Report, plain
from tests.hard_cases.models import QUICK
from tests.hard_cases.of_effects import SEEDS

KINDS = ("case", "effect", "model", "start", "long")
RANDOM_STARTS = 16  # seeds of these


def jobs_of(kind: str, device: str, precision: str, seeds: int) -> list[Job]:
    """All of a kind, in an order in which the seeds of a case are apart: what is left out is of few seeds, not of few
    cases."""
    names = list(TABLES[kind])
    if kind == "case":
        found = [Job(kind, name, seed, precision) for seed in range(seeds) for name in names]
        return found + _finer(kind, names, device, precision)
    if kind == "model":
        names = names if device == "cpu" else [case.name for case in QUICK]
        return [Job(kind, name, 0, precision) for name in names] + _finer(kind, names, device, precision)
    if kind == "effect":
        return [Job(kind, name, seed, precision) for seed in range(seeds) for name in names]
    if kind == "start":
        most = RANDOM_STARTS if device == "cpu" else seeds
        return [Job(kind, name, seed, precision) for seed in range(most) for name in names]
    return [Job(kind, name) for name in names]


def _finer(kind: str, names: list[str], device: str, precision: str) -> list[Job]:
    """Those of which the energy may rise, with a tenth of the time step."""
    if device != "cpu" or precision in ROUNDING:
        return []
    rising = [name for name in names if TABLES[kind][name].energy > 1e-6 and not TABLES[kind][name].fails]
    return [Job(kind, name, finer=True) for name in rising]


def quickly() -> list[Job]:
    """A smoke run: a few of each kind."""
    some = [("case", 0, 12), ("effect", 5, 1), ("model", 0, 60), ("start", 0, 12), ("long", 0, 9)]
    found = [Job(kind, name, quick=True) for kind, first, by in some for name in list(TABLES[kind])[first::by][:4]]
    return [job for job in found if job.kind != "start"] + [Job("start", list(TABLES["start"])[6])]


def main(
    quick: Annotated[bool, typer.Option("--quick", help="A smoke run of a few cases")] = False,
    device: Annotated[str, typer.Option(help="cpu or gpu")] = "cpu",
    precision: Annotated[list[str] | None, typer.Option(help="Of a GPU, one or more [default: float64]")] = None,
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(KINDS)} [default: all but long]")] = None,
    name: Annotated[list[str] | None, typer.Option(help="Beginnings of names of cases [default: all]")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Of cases and effects")] = SEEDS,
    jobs: Annotated[int, typer.Option(min=1, help="Processes")] = 1,
    limit: Annotated[float, typer.Option(min=0, help="Seconds after which nothing new begins, 0: no limit")] = 0,
    merge: Annotated[list[Path] | None, typer.Option(help="Only make one page of these results")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/hard_cases]")] = None,
) -> None:
    """Hard cases: what must hold, and what was measured."""
    if merge:
        parts = [json.loads(path.read_text()) for path in merge]
        write_page([part for each in parts for part in each["data"]["parts"]], out, quick=False, merged=parts[-1])
        return
    kinds, precisions = only or [kind for kind in KINDS if kind != "long"], precision or ["float64"]
    wanted = quickly() if quick else [
        job for kind in kinds for p in precisions for job in jobs_of(kind, device, p, seeds)
    ]  # fmt: skip
    wanted = [job for job in wanted if job.name.startswith(tuple(name or [""]))]
    told = {"device": device, "precision": " ".join(precisions), "only": " ".join(kinds), "seeds": seeds, "jobs": jobs}
    report = Report("hard_cases", "Hard cases", told, out, quick)
    begun = report.head()
    rows, left_out = run_all(wanted, device, jobs, limit)
    part: Row = {
        "head": begun, "told": told, "rows": rows, "wall": sum(row["wall"] for row in rows), "limit": limit,
        "left_out": [f"{job.kind} {job.name}, seed {job.seed}, {job.precision}" for job in left_out],
    }  # fmt: skip
    part["seconds"] = report.seconds()
    report.data["parts"] = [plain(part)]
    report.save(report.header())  # before the page, whose pictures need more packages
    write_page([plain(part)], out, quick, report=report)
    if not quick and any(row.get("unexpected") or row["error"] for row in rows if device == "cpu"):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
