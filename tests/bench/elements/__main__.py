# SPDX-License-Identifier: MIT
"""Error of the motion that mesh and kind of elements leave, against the time of a step and against nodes.

All move the same cantilever with the same scheme and time step. The reference is a finer mesh of quadratic elements, so
errors are those of the mesh alone.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer
from numpy.typing import NDArray

from sim_server.scene.elements import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.report import Report, plots
from tests.bench.harness.schemes import SCENES

SIZE = (1.0, 1.0, 4.0)  # m
CELLS: dict[str, list[int]] = {"linear": [1, 2, 3, 4, 6, 8], "patch": [1, 2, 3, 4, 6], "smoothed": [1, 2, 3, 4],
                               "quadratic": [1, 2, 3]}  # fmt: skip
FINEST = 5  # of the reference, quadratic elements
WANTED = 0.02  # error over the length
HOW = """\
A bar of 1 x 1 x 4 m (corotational, E = 1 MPa, 1000 kg/m3, Rayleigh damping of the mass 0.1/s, split mirrored), clamped
at one end, let go from horizontal under gravity. n x n x 4n cells of six tetrahedra; quadratic elements have as many,
with mid-nodes. Scheme ros2 with steps of 10 ms; factors by lockstep-4, made between the steps and not counted: of a
server, a worker on another core makes them. Error: root mean square over time of the distance of eight points, the
corners of the free face and the edges' middles, from where they are with {finest} x {finest} x {four} cells of
quadratic elements, over the length. ms a step: of the loop, median over the steps and then
over the rounds, in which the kinds take turns."""


@dataclass
class Run:
    """A kind of elements on one mesh at one Poisson's ratio, over rounds."""

    poisson: float
    kind: str
    cells: int
    nodes: int = 0
    blocks: int = 0  # of A, both triangles
    milliseconds: list[float] = field(default_factory=list)
    iterations: float = 0.0
    error: float = 0.0  # over the length

    def table(self) -> dict[str, Any]:
        low, high = min(self.milliseconds), max(self.milliseconds)
        return {
            "ν": self.poisson, "elements": self.kind, "cells": f"{self.cells}x{self.cells}x{4 * self.cells}",
            "nodes": self.nodes, "blocks a row": self.blocks / self.nodes,
            "ms a step": float(np.median(self.milliseconds)), "range": f"{low:.3g} … {high:.3g}",
            "iterations": self.iterations, "error / L": f"{self.error:.1e}",
        }  # fmt: skip


def motion(kind: str, cells: int, poisson: float, steps: int) -> tuple[Simulation, Any, NDArray[np.float64]]:
    """Returns the simulation, the records and the paths of the eight points, (steps, 8, 3) [m]."""
    law = f"{{ young = 1e6, poisson = {poisson} }}"
    sim = Simulation.load(SCENES / "beam.toml", [
        f"object.beam.mesh={{ bar = [{cells}, {cells}, {4 * cells}], size = [1, 1, 4], split = 'mirrored' }}",
        f"object.beam.elements={kind}", f"object.beam.effects.corotational={law}", "dt=0.01",
        "integrator.scheme=ros2", "solver.preconditioner=cholesky", "solver.update=lockstep-4",
    ])  # fmt: skip
    rest = sim.world.rest
    points = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (2.0, 4.0)]
    at = [int(np.abs(rest - point).sum(axis=1).argmin()) for point in points]
    assert np.allclose(rest[at], points)
    driver, records, paths = Driver(sim), [], []
    for _ in range(steps):
        records.append(driver.advance(1))
        paths.append(sim.world.x[at].copy())
    return sim, np.concatenate(records), np.array(paths)


def measure(poisson: float, meshes: dict[str, list[int]], finest: int, steps: int, rounds: int) -> list[Run]:
    """Runs of all kinds and meshes at one Poisson's ratio."""
    exact = motion("quadratic", finest, poisson, steps)[2]
    runs = [Run(poisson, kind, cells) for kind, each in meshes.items() for cells in each]
    for run in [run for _ in range(rounds) for run in runs]:
        sim, records, paths = motion(run.kind, run.cells, poisson, steps)
        run.nodes, run.blocks = sim.world.nodes, len(sim.system.columns)
        run.milliseconds.append(1e3 * float(np.median(records["whole"])))
        run.iterations = float(records["iterations"].mean())
        run.error = float(np.sqrt(((paths - exact) ** 2).sum(axis=2).mean())) / SIZE[2]
        print(f"nu {poisson}, {run.kind} {run.cells}: {run.milliseconds[-1]:.3g} ms, error {run.error:.1e}", flush=True)
    return runs


def time_at(runs: Iterable[Run], wanted: float) -> float | None:
    """Time of a step [ms] at which a kind has an error, between its meshes on a line of logarithms.

    None: none of its meshes has so small an error.
    """
    points = sorted((run.error, float(np.median(run.milliseconds))) for run in runs)
    if not points or wanted < points[0][0]:
        return None
    error, time = np.log(np.array(points)).T
    return float(np.exp(np.interp(np.log(wanted), error, time)))


def answers(runs: list[Run]) -> list[dict[str, Any]]:
    """By Poisson's ratio, what a step takes with each kind at the error wanted, and the least error of linear ones."""
    found = []
    for poisson in dict.fromkeys(run.poisson for run in runs):
        of = {kind: [r for r in runs if (r.poisson, r.kind) == (poisson, kind)] for kind in CELLS}
        line: dict[str, Any] = {"ν": poisson}
        line |= {f"{kind}, ms": time_at(each, WANTED) for kind, each in of.items()}
        best = min((t, kind) for kind in CELLS if (t := line[f"{kind}, ms"]) is not None)
        linear = line["linear, ms"]
        line["cheapest"] = best[1]
        line["times cheaper than linear"] = (
            linear / best[0] if linear else f"more than {_slowest(of['linear']) / best[0]:.3g}"
        )
        found.append(line)
    return found


def _slowest(runs: list[Run]) -> float:
    return max(float(np.median(run.milliseconds)) for run in runs)


def diagram(runs: list[Run]) -> Any:
    """Error over milliseconds, one panel per Poisson's ratio."""
    plt = plots()
    ratios = list(dict.fromkeys(run.poisson for run in runs))
    figure, axes = plt.subplots(1, len(ratios), figsize=(4 * len(ratios), 4.2), sharey=True, squeeze=False,
                                layout="constrained")  # fmt: skip
    for axis, poisson in zip(axes[0], ratios, strict=True):
        for kind in CELLS:
            line = [run for run in runs if run.poisson == poisson and run.kind == kind]
            axis.plot(
                [np.median(run.milliseconds) for run in line], [run.error for run in line], marker="o", label=kind
            )
        axis.axhline(WANTED, color="gray", linewidth=0.8)
        axis.set(title=f"Poisson's ratio {poisson:g}", xlabel="ms a step", xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].set_ylabel("error of the motion / length")
    axes[0][0].legend()
    return figure


def main(
    end: Annotated[float, typer.Option(help="Simulated time of each run [s]")] = 1.0,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the kinds taking turns")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/elements]")] = None,
) -> None:
    """Error of the motion against the time of a step, for all kinds of elements."""
    assert set(CELLS) == set(get_args(Kind))
    meshes, finest, ratios = CELLS, FINEST, [0.3, 0.45, 0.49, 0.499]
    if quick:
        meshes, finest, ratios, end, rounds = {kind: [1] for kind in CELLS}, 2, [0.45], 0.1, 1
    report = Report("elements", "Kinds of elements", {"end": end, "rounds": rounds}, out, quick)
    runs = [run for poisson in ratios for run in measure(poisson, meshes, finest, round(end / 0.01), rounds)]
    report.say(HOW.format(finest=finest, four=4 * finest))
    report.say(f"## Time of a step at an error of {100 * WANTED:g} %", "Between meshes, on a line of logarithms.")
    report.table(answers(runs))
    report.figure(diagram(runs), "elements.png", "Error of the motion against the time of a step.")
    report.say("## All runs")
    report.table([run.table() for run in runs])
    report.data["runs"] = [vars(run) for run in runs]
    report.remember([run.table() for run in runs if run.poisson == 0.45], ("elements", "cells"), ("ms a step",))
    report.write()


if __name__ == "__main__":
    typer.run(main)
