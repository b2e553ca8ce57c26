# SPDX-License-Identifier: MIT
"""Runs hard cases in processes beside each other; what each came to is a row of plain values, which several runs of the
bench, on several machines, can put together to one page (page.py)."""

import tempfile
import time
from collections import Counter
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.errors import InputError
from tests.hard_cases.case import Case
from tests.hard_cases.effect_table import EFFECT_CASES
from tests.hard_cases.long_runs import LONG_RUNS, run_long
from tests.hard_cases.models import MODEL_CASES
from tests.hard_cases.of_effects import EffectCase, run_effect_case
from tests.hard_cases.running import Outcome, broken, finer, run_case, seeded, unexpected
from tests.hard_cases.seeds import SEEDED, SPLITS, fate
from tests.hard_cases.table import CASES

Row = dict[str, Any]
STARTS = [f"{law}, {split}" for law, split in product(SEEDED, SPLITS)]
TABLES: dict[str, Any] = {
    "case": {case.name: case for case in CASES}, "effect": {case.name: case for case in EFFECT_CASES},
    "model": {case.name: case for case in MODEL_CASES}, "long": {run.name: run for run in LONG_RUNS},
    "start": {name: (law, split) for name, (law, split) in zip(STARTS, product(SEEDED, SPLITS), strict=True)},
}  # fmt: skip
ROUNDING = {"mixed": 1e-4, "float32": 1e-3}  # of the energy, over what is dissipated


@dataclass(frozen=True)
class Job:
    """kind: of TABLES; finer: with a tenth of the time step; quick: a short form."""

    kind: str
    name: str
    seed: int = 0
    precision: str = "float64"
    finer: bool = False
    quick: bool = False


def of_precision(case: Case, precision: str) -> Case:
    """What must hold of a case in a precision: solves may end at its rounding."""
    if precision not in ROUNDING or case.refused:
        return case
    more = {"max_iterations": case.steps, "max_linearizations": case.steps}
    return replace(
        case, energy=max(case.energy, ROUNDING[precision]), within=max(case.within, 1e-3),
        unconverged=case.unconverged | more,
    )  # fmt: skip


def effect_of_precision(case: EffectCase, precision: str) -> EffectCase:
    """Likewise."""
    if precision not in ROUNDING:
        return case
    most = max(case.most, ROUNDING[precision]) if case.most >= 0 else case.most
    return replace(case, most=most, unconverged=case.unconverged | {"max_iterations": 10_000})


def made(device: str, job: Job) -> Row:
    """The row of a job: wrong, refused (by an error for users) or error, as texts, beside what was measured."""
    row: Row = {"kind": job.kind, "name": job.name, "seed": job.seed, "device": device, "precision": job.precision}
    row |= {"finer": job.finer, "wrong": "", "refused": "", "error": ""}
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
            row |= _measured(job, device, Path(folder))
    except InputError as error:
        row["refused"] = str(error)[:300]
    except Exception as error:  # told as what does not hold
        row["error"] = row["wrong"] = f"{type(error).__name__}: {str(error)[:300]}"
    return row | {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def _measured(job: Job, device: str, folder: Path) -> Row:
    entry = TABLES[job.kind][job.name]
    if job.kind == "effect":
        return _of_effect(effect_of_precision(entry, job.precision), job, device)
    if job.kind == "start":
        law, split = entry
        return {"end": fate(law, split, job.seed, device=device, precision=job.precision)}
    if job.kind == "long":
        found = run_long(entry, 1000 if job.quick else entry.steps)
        return {"steps": 1000 if job.quick else entry.steps, "wrong": "; ".join(found.wrong(entry)), **vars(found)}
    case = of_precision(seeded(entry, job.seed), job.precision)
    case = finer(case) if job.finer else case
    compare = job.seed == 0 and not job.finer
    return _of_case(case, run_case(case, folder, device, job.precision, compare=compare))


def _of_case(case: Case, out: Outcome) -> Row:
    return {
        "wrong": "; ".join(broken(case, out)), "unexpected": "; ".join(unexpected(case, out)), "energy": out.energy,
        "rise": out.rise, "dissipated": out.dissipated, "status": dict(out.status), "fallbacks": out.fallbacks,
        "iterations": float(out.iterations.mean()), "most_iterations": float(out.iterations.max()),
        "distance": out.distance, "recovered": out.recovered, "lowest": out.lowest, "upright": out.upright,
        "volume": list(out.volume), "residual": out.residual, "curve": list(out.curve), "home": out.home,
        "cost": out.cost and list(out.cost),
    }  # fmt: skip


def _of_effect(case: EffectCase, job: Job, device: str) -> Row:
    out = run_effect_case(case, job.seed, device, job.precision, compare=job.seed == 0)
    wrong = "; ".join(out.wrong)
    return {
        "wrong": wrong, "unexpected": ("" if wrong else "stated to fail, and it holds") if case.fails else wrong,
        "value": out.value, "status": dict(out.status), "iterations": float(out.iterations.mean()),
        "most_iterations": float(out.iterations.max()), "volume": list(out.volume), "lowest": out.lowest,
        "residual": out.residual, "cost": out.cost and list(out.cost),
    }  # fmt: skip


def run_all(jobs: list[Job], device: str, processes: int, limit: float) -> tuple[list[Row], list[Job]]:
    """Rows in the order of the jobs, and what had not begun after so many seconds (0: no limit)."""
    until, make = time.monotonic() + (limit or float("inf")), partial(made, device)
    if processes == 1:
        done = [_told(make(job)) for job in jobs if time.monotonic() < until]
        return done, jobs[len(done) :]
    found: dict[Job, Row] = {}
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        futures: dict[Future[Row], Job] = {pool.submit(make, job): job for job in jobs}
        left = set(futures)
        while left and time.monotonic() < until:
            ready, left = wait_for(left, min(1.0, max(until - time.monotonic(), 0.01)))
            found |= {futures[future]: _told(future.result()) for future in ready}
        late = {future for future in left if not future.cancel()}
        found |= {futures[future]: _told(future.result()) for future in late}
    return [found[job] for job in jobs if job in found], [job for job in jobs if job not in found]


def _told(row: Row) -> Row:
    said = (row["refused"] and f"refused: {row['refused']}") or row["wrong"]
    print(row["kind"], row["name"], row["seed"], row["precision"], f"{row['wall']:.1f} s", said, flush=True)
    return row


def counts(rows: list[Row]) -> str:
    """n of m seeds hold, and how many were refused."""
    refused = sum(bool(row["refused"]) for row in rows)
    if rows and refused == len(rows):
        return "refused"
    holding = sum(not row["wrong"] and not row["refused"] for row in rows)
    return f"{holding} of {len(rows)}" if rows else "–"


def status_of(rows: list[Row]) -> str:
    """All statuses but converged, of all steps, with how often."""
    found = sum((Counter(row.get("status", {})) for row in rows), Counter[str]())
    return ", ".join(f"{n} × {name}" for name, n in found.items() if name != "converged") or "converged"
