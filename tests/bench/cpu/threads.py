# SPDX-License-Identifier: MIT
"""A step of one body on several threads: the same run on each number of them, in turns.

All make the same steps from the same factors, which one of them makes of its matrix at the start of each turn; they are
made on one thread and are no part of the times.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker.factorization.factorize import Analysis
from sim_server.simulation import Simulation
from tests.bench.harness.report import Report, plots

TURN = 8  # steps from one factor, and of one number of threads before the next
TURNS = {540: 24, 3000: 24, 7350: 16, 24000: 12, 98304: 5}
Row = dict[str, Any]


class Side:
    """The run on one number of threads."""

    def __init__(self, simulation: Simulation):
        self.simulation = simulation
        self.records: list[NDArray[Any]] = []

    def assemble(self) -> NDArray[np.float64]:
        """Begins a step; returns the matrix."""
        self.simulation.engine.assemble()
        return self.simulation.engine.factor_matrix(0)

    def take(self, factor: tuple[Any, NDArray[Any]], begun: bool) -> None:
        """A turn with a factor. begun: its first step is assembled."""
        engine = self.simulation.engine
        engine.post_factor(0, *factor, step=engine.step)
        if begun:
            engine.solve()
        engine.run(TURN - begun)
        self.records.append(engine.records()[1:])  # the first one of one run has a factorization within


def measure(simulations: dict[int, Simulation], turns: int) -> list[Row]:
    """A row for each number of threads. simulations: of the same scene, by that number."""
    sides = {threads: Side(simulation) for threads, simulation in simulations.items()}
    first = next(iter(sides))
    arrays = simulations[first].system
    analysis = Analysis(arrays.row_start, arrays.columns)
    for _ in range(turns):
        matrix = sides[first].assemble()
        factor = analysis.pattern, analysis.factorize(matrix, np.dtype(np.float32))
        for threads, side in sides.items():
            side.take(factor, begun=threads == first)
    x = simulations[first].world.x
    same = all(np.array_equal(s.world.x, x) for s in simulations.values())
    return [_row(threads, side, same) for threads, side in sides.items()]


def _row(threads: int, side: Side, same: bool) -> Row:
    turns = [1e3 * (r["assemble"] + r["solve"] + r["integrate"]) for r in side.records]
    whole, medians = np.concatenate(turns), [float(np.median(turn)) for turn in turns]
    every = np.concatenate(side.records)
    return {
        "threads": threads, "ms p50": float(np.median(whole)), "of turns": f"{min(medians):.3g} to {max(medians):.3g}",
        "p99": float(np.percentile(whole, 99)), "max": float(whole.max()),
        "assemble": 1e3 * float(np.median(every["assemble"])), "solve": 1e3 * float(np.median(every["solve"])),
        "us an iteration": 1e6 * float(np.median(every["solve"] / np.maximum(every["iterations"], 1))),
        "iterations": float(every["iterations"].mean()), "same bits": same, "steps": len(whole),
    }  # fmt: skip


def tell(report: Report, rows: Sequence[Row]) -> None:
    """The part of the page."""
    report.say(
        "## Threads",
        "One body on `[solver] threads` = 1, 2, ... of the cores named above, the same beam in turns of "
        f"{TURN} steps with a new factor each (float32, made beside the steps): wall ms of steps, median, 99th "
        "percentile and largest; medians of turns; medians of the assembly and of the solve. *same bits*: positions at "
        "the end are those of one thread.",
    )
    report.table([{**row, "times faster": _first(rows, row)["ms p50"] / row["ms p50"]} for row in rows])


def _first(rows: Sequence[Row], row: Row) -> Row:
    return next(other for other in rows if other["tets"] == row["tets"])


def draw(report: Report, rows: Sequence[Row]) -> None:
    """Time of a step over the number of threads."""
    plt = plots()
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    for tets in sorted({row["tets"] for row in rows}):
        mine = [row for row in rows if row["tets"] == tets]
        axes.loglog([r["threads"] for r in mine], [r["ms p50"] for r in mine], "o-", label=f"{tets} tetrahedra")
        axes.loglog([r["threads"] for r in mine], [mine[0]["ms p50"] / r["threads"] for r in mine], "k:", lw=0.7)
    axes.set(xlabel="threads", ylabel="ms per step")
    axes.legend()
    report.figure(figure, "cpu_threads.png", "Median wall time of a step; dotted: the first one divided by the threads")
