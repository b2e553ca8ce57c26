# SPDX-License-Identifier: MIT
"""Steps with an old factor where the body moves fast: a heterogeneous beam that is let go, with and without the exact
solve that is put around the factor where the matrix has changed most (native/local_refresh.h).

Both make the same steps in turns, from factors that one of them makes of its own matrix each EVERY steps, on one
thread and beside the times.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import Problem
from tests.bench.harness.report import Report

EVERY = 16  # steps from one factor
Row = dict[str, Any]


def measure(tets: int, steps: int, threads: int) -> list[Row]:
    """A row with, and one without."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Problem(tets, "heterogeneous").write(Path(folder))
        sides = {name: Simulation.load(scene, [f"solver.threads={threads}"]) for name in ("refreshed", "as it is")}
    sides["as it is"].engine.forget_matrices(0)
    first = sides["refreshed"]
    analysis = Analysis(first.system.row_start, first.system.columns)
    found: dict[str, list[tuple[Any, int]]] = {name: [] for name in sides}
    for _ in range(steps // EVERY):
        for name, side in sides.items():
            engine = side.engine
            engine.assemble()
            values = analysis.factorize(engine.factor_matrix(0), np.float32)
            engine.post_factor(0, analysis.pattern, values, step=engine.step)
            engine.solve()
            for _ in range(EVERY - 1):
                engine.run(1)
                found[name].append((engine.records()[-1], engine.refreshed(0)))
    return [_row(tets, threads, name, rows) for name, rows in found.items()]


def _row(tets: int, threads: int, name: str, rows: Sequence[tuple[Any, int]]) -> Row:
    records: NDArray[Any] = np.array([record for record, _ in rows])
    nodes = np.array([n for _, n in rows])
    whole, iterations = 1e3 * records["whole"], records["iterations"]
    return {
        "tets": tets, "threads": threads, "factor": name, "iterations": float(iterations.mean()),
        "p99": float(np.percentile(iterations, 99)), "most": int(iterations.max()),
        "ms p50": float(np.median(whole)), "ms p99": float(np.percentile(whole, 99)), "ms max": float(whole.max()),
        "steps with it": int((nodes > 0).sum()), "nodes, most": int(nodes.max()), "steps": len(rows),
    }  # fmt: skip


def tell(report: Report, rows: Sequence[Row]) -> None:
    """The part of the page."""
    report.say(
        "## Factors too old for what happened",
        f"A beam of three stiffnesses 1 : 0.05 : 0.01 that is let go, dt 30 ms, a factor each {EVERY} steps (the step "
        "that has it of its own matrix does not count), tolerance 1e-6. *refreshed*: a solve that is slow with its "
        "factor puts an exact one around it on the nodes whose own blocks of the matrix have changed most "
        "([how](../preconditioners.md#where-a-body-changed-most)); *as it is*: it does not.",
    )
    report.table(rows)
