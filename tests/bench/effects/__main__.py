# SPDX-License-Identifier: MIT
"""What each effect costs in a scene that lists it, and that it costs nothing in one that does not."""

import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from sim_server.effects import known_effects
from tests.bench.effects.cost import Row
from tests.bench.effects.measured import measured
from tests.bench.harness.report import Report, plots
from tests.support.absent_effect import copy_packages
from tests.support.effect_samples import SAMPLES, Cells

SMOKE = ("gravity", "rayleigh", "contact")
COSTS = """\
A beam of 1 x 1 x 4 m by linear corotational tetrahedra, fixed at one end, swings under gravity (what a sample has
beside it is in tests/support/effect_samples.py), dt 20 ms, backward Euler, with the effect and without it. Both are in
one process and make batches of steps in turns. Time: of the processor, of the thread that makes the steps, median over
the batches; the ratio is the median of those of each round. A factor of A is made between the batches, which is not
counted, and used in the steps of the batch; iterations are means. A law is added to the one that the beam has, so that
it bears load beside it; bodies that are stiffer or damped move less, and their factors serve longer.
Launches, kernels, bytes of arrays, keys of the network and channels of the log are those of
`sim-server SCENE --explain`. A floor is out of reach of the beam (contact), and nothing is pushed (touch)."""
NOTHING = """\
The scene without the effect, by a copy of the packages, and by one in which the files of the effect do not exist
(sim_server/effects: its module, its kernel texts), each in a process of its own; batches in turns, times as above, with
block Jacobi for a preconditioner. State: positions and velocities after some steps, to the bit. Launches, texts that
are compiled, modules that are imported: the whole lists. Kernels, bytes, keys and channels: what the one asks for more
than the other. The ratio is the median of those of each round; their range tells how far times of equal programs are
apart."""


def diagram(rows: list[Row]) -> Any:
    """What each effect adds to the time of a step."""
    plt = plots()
    figure, axis = plt.subplots(figsize=(7, 0.28 * len(rows) + 1.2), layout="constrained")
    ordered = sorted(rows, key=lambda row: row["ratio"])
    axis.barh([row["effect"] for row in ordered], [row["ratio"] - 1 for row in ordered])
    axis.set(xlabel="time of a step with the effect over that without it, less 1")
    axis.grid(True, axis="x", alpha=0.3)
    return figure


def main(
    effects: Annotated[list[str] | None, typer.Option("--effect", help="One of those measured [default: all]")] = None,
    rounds: Annotated[
        int, typer.Option(min=2, help="Batches of steps of each scene; without an effect twice as many")
    ] = 30,
    starts: Annotated[int, typer.Option(min=1, help="Pairs of processes without an effect")] = 3,
    jobs: Annotated[int, typer.Option(min=1, help="Effects measured at a time, each on cores of its own")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/effects]")] = None,
) -> None:
    """Time, memory and iterations that each effect adds, and the distance from a build without it."""
    cells: Cells = (5, 5, 20)
    names = effects or list(SMOKE if quick else known_effects())
    if quick:
        cells, rounds, starts = (1, 1, 4), 2, 1
    if missing := sorted(set(names) - set(SAMPLES)):
        raise typer.BadParameter(f"no samples of {', '.join(missing)} in tests/support/effect_samples.py")
    told = {"tets": 6 * cells[0] * cells[1] * cells[2], "rounds": rounds, "starts": starts, "jobs": jobs}
    report = Report("effects", "What each effect costs", told | ({"effect": effects} if effects else {}), out, quick)
    costs, absences = [], []
    with tempfile.TemporaryDirectory() as folder:
        copy_packages(Path(folder) / "whole")
        measure = partial(measured, cells, rounds, starts, Path(folder))
        with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
            for row, absent in pool.map(measure, names) if jobs > 1 else map(measure, names):
                costs.append(row)
                absences.append(absent)
                print(
                    f"{row['effect']}: {row['ratio']:.3f} with it, {absent['ratio']:.3f} without its files", flush=True
                )
    report.say("## Listed", COSTS)
    report.table(costs)
    report.figure(diagram(costs), "effects.png", "What each effect adds to the time of a step.")
    report.say("## Not listed", NOTHING)
    report.table(absences)
    report.data |= {"costs": costs, "absences": absences}
    report.remember(costs, ("effect",), ("ms", "iterations"))
    report.write()


if __name__ == "__main__":
    typer.run(main)
