# SPDX-License-Identifier: MIT
"""Runs hard cases in processes beside each other, each job by its number in a table."""

import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import replace
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tests.hard_cases.case import Case
from tests.hard_cases.effect_table import EFFECT_CASES
from tests.hard_cases.long_runs import LONG_RUNS, run_long
from tests.hard_cases.models import MODEL_CASES, QUICK
from tests.hard_cases.of_effects import run_effect_case
from tests.hard_cases.running import finer, run_case
from tests.hard_cases.seeds import SEEDED, SPLITS, tally
from tests.hard_cases.table import CASES

Job = tuple[str, int, int, str]  # kind, number in its table, seed (of starts: how many), precision
STARTS = list(product(SEEDED, SPLITS))
TABLES: dict[str, list[Case]] = {"case": CASES, "model": QUICK, "of models": MODEL_CASES}


ROUNDING = {"mixed": 1e-5, "float32": 1e-3}  # of the energy, over what is dissipated


def of_precision(case: Case, precision: str) -> Case:
    """What must hold of a case in a precision: solves may end at its rounding."""
    if precision not in ROUNDING or case.refused:
        return case
    more = {"max_iterations": case.steps, "max_linearizations": case.steps}
    return replace(
        case, energy=max(case.energy, ROUNDING[precision]), within=max(case.within, 1e-3),
        unconverged=case.unconverged | more,
    )  # fmt: skip


def made(device: str, job: Job) -> Any:
    """The outcome of a job; a text if it ended with an error."""
    kind, index, seed, precision = job
    precision = precision or "float64"
    try:
        with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
            if kind == "effect":
                return run_effect_case(EFFECT_CASES[index], seed, device, precision)
            if kind == "starts":
                name, split = STARTS[index]
                return {"law": name, "split": split, **tally(name, split, range(seed))}
            if kind == "long":
                return run_long(LONG_RUNS[index], 1000 if seed else LONG_RUNS[index].steps)
            case = of_precision(TABLES[kind][index], precision)
            return run_case(finer(case) if seed else case, Path(folder), device, precision)
    except Exception as error:  # told as what does not hold
        return f"{type(error).__name__}: {str(error)[:200]}"


class Runs:
    """jobs: processes; limit: seconds after which what has not begun is left out, 0: none."""

    def __init__(self, jobs: int = 1, device: str = "cpu", limit: float = 0):
        self._jobs, self._made = jobs, partial(made, device)
        self._until = time.monotonic() + limit if limit else float("inf")

    def all(self, jobs: list[Job]) -> list[tuple[Job, Any]]:
        """The jobs that were made in time, in their order, with their outcomes."""
        if self._jobs == 1:
            return [(job, self._told(job, self._made(job))) for job in jobs if time.monotonic() < self._until]
        with ProcessPoolExecutor(self._jobs, get_context("spawn")) as pool:
            futures: dict[Future[Any], Job] = {pool.submit(self._made, job): job for job in jobs}
            left = self._until - time.monotonic()
            done, late = wait_for(futures, None if left == float("inf") else max(left, 0))
            for future in late:
                future.cancel()
            found = {futures[future]: self._told(futures[future], future.result()) for future in done}
        return [(job, found[job]) for job in jobs if job in found]

    def of_cases(self, cases: list[Case], finer_too: Callable[[Case], bool]) -> Iterator[tuple[tuple[int, bool], Any]]:
        """The outcome of each case by its number and whether it was made with a tenth of the time step."""
        kind = next(name for name, table in TABLES.items() if all(case in table for case in cases))
        jobs: list[Job] = []
        for case in cases:
            number = TABLES[kind].index(case)
            jobs += [(kind, number, finer, "") for finer in (0, 1)[: 1 + finer_too(case)]]
        for job, out in self.all(jobs):
            if isinstance(out, str):
                raise RuntimeError(f"{TABLES[kind][job[1]].name}: {out}")
            yield (cases.index(TABLES[kind][job[1]]), bool(job[2])), out

    def _told(self, job: Job, out: Any) -> Any:
        print(*job, out if isinstance(out, str) else "", flush=True)
        return out
