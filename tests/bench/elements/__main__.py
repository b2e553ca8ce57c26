# SPDX-License-Identifier: MIT
"""Error of the motion that mesh and kind of elements leave, against the time of a step and against nodes.

All move the same cantilever with the same scheme and time step. The reference is a finer mesh of quadratic elements, so
errors are those of the mesh alone.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import typer
from numpy.typing import NDArray

from sim_server.scene.elements import Kind
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.elements import factors
from tests.bench.harness.report import Report, plots
from tests.bench.harness.schemes import SCENES

LENGTH = 4.0  # m
BOXES = Path(__file__).parents[1] / "verification" / "meshes"  # made with Gmsh, all edges about as long
CELLS: dict[str, list[int]] = {"linear": [2, 4, 6, 8], "patch": [2, 4, 6], "smoothed": [1, 2, 4], "quadratic": [1, 2]}
TETS: dict[str, list[int]] = {
    "linear": [218, 434, 1429, 5025, 10071], "patch": [218, 434, 1429, 5025], "smoothed": [218, 434, 1429],
    "quadratic": [218, 434],
}  # fmt: skip
FINEST = 5  # of the reference, quadratic elements
WANTED = (0.01, 0.02)  # errors over the length
ONCE = ("integrator.scheme=ros2", "integrator.solve=iterate")
NEWTON = ("integrator.scheme=newmark", "integrator.linearizations=8")
SCHEMES = {0.3: ONCE, 0.45: ONCE, 0.49: ONCE, 0.499: NEWTON}  # by Poisson's ratio
HOW = """\
A bar of 1 x 1 x 4 m (corotational, E = 1 MPa, 1000 kg/m3, Rayleigh damping of the mass 0.1/s), clamped at one end,
let go from horizontal under gravity. *mirrored*: n x n x 4n cells of six tetrahedra each; *unstructured*: made with
Gmsh. Quadratic elements have as many, with mid-nodes. Steps of 10 ms, of ros2 with `solve = "iterate"`, so that an
old factor costs iterations and leaves no error; at a Poisson's ratio of 0.499 of newmark with Newton-Raphson, because
there every scheme with one linearization, whatever the elements, is 1 to 4 % of the length off in this motion.
Factors by lockstep-4, made between the steps and not counted: of a server, a worker on another core makes them.
Error: root mean square over time of the distance of the four corners of the free face from where they are with
{finest} x {finest} x {four} cells of quadratic elements and the same steps, over the length. ms a step: of a CPU the
processor time of the loop, of a GPU the time of the device, median over the steps and the rounds, in which kinds take
turns."""
PICTURES = {"cpu": "elements.png", "gpu": "elements_gpu.png"}
BETWEEN = "Between meshes on a line of logarithms; where a coarsest mesh is more exact, the time of that."


def meshes(quick: bool) -> dict[str, dict[str, list[str]]]:
    """`mesh` tables of an object, by family and kind of elements."""
    if quick:
        return {"mirrored": {kind: [_bar(1)] for kind in CELLS}, "unstructured": {"smoothed": [_box(218)]}}
    return {
        "mirrored": {kind: [_bar(n) for n in cells] for kind, cells in CELLS.items()},
        "unstructured": {kind: [_box(tets) for tets in each] for kind, each in TETS.items()},
    }


def _bar(n: int) -> str:
    return f"{{ bar = [{n}, {n}, {4 * n}], size = [1, 1, 4], split = 'mirrored' }}"


def _box(tets: int) -> str:
    return f"{{ file = '{BOXES / f'box_{tets}.vtu'}' }}"


@dataclass
class Run:
    """A kind of elements on one mesh at one Poisson's ratio on a device, over rounds."""

    device: str
    poisson: float
    family: str
    kind: str
    mesh: str
    tets: int = 0
    nodes: int = 0
    blocks: int = 0  # of A, both triangles
    milliseconds: list[float] = field(default_factory=list)
    iterations: float = 0.0
    error: float = 0.0  # over the length

    def table(self) -> dict[str, Any]:
        low, high = min(self.milliseconds), max(self.milliseconds)
        return {
            "device": self.device,
            "ν": self.poisson, "mesh": self.family, "elements": self.kind, "tets": self.tets, "nodes": self.nodes,
            "blocks a row": self.blocks / self.nodes,
            "ms a step": float(np.median(self.milliseconds)), "range": f"{low:.3g} … {high:.3g}",
            "iterations": self.iterations, "error / L": f"{self.error:.1e}",
        }  # fmt: skip


def motion(
    kind: str, mesh: str, poisson: float, steps: int, device: str = "cpu"
) -> tuple[Simulation, Any, NDArray[np.float64]]:
    """Returns the simulation, the records and the paths of the corners of the free face, (steps, 4, 3) [m]."""
    nearest = min(SCHEMES, key=lambda known: abs(known - poisson))
    law = f"{{ young = 1e6, poisson = {poisson} }}"
    sim = Simulation.load(SCENES / "beam.toml", [
        f"object.beam.mesh={mesh}", f"object.beam.elements={kind}", f"object.beam.effects.corotational={law}",
        "dt=0.01", *SCHEMES[nearest],
        "solver.preconditioner=cholesky", "solver.update=lockstep-4",
    ], device)  # fmt: skip
    rest, corners = sim.world.rest, [(x, y, LENGTH) for x in (0.0, 1.0) for y in (0.0, 1.0)]
    at = [int(np.abs(rest - point).sum(axis=1).argmin()) for point in corners]
    assert np.allclose(rest[at], corners)
    driver, records, paths = Driver(sim), [], []
    for _ in range(steps):
        records.append(driver.advance(1))
        paths.append(sim.fetch().x[at].copy())
    return sim, np.concatenate(records), np.array(paths)


def measure(poisson: float, finest: int, steps: int, rounds: int, devices: list[str], quick: bool) -> list[Run]:
    """Runs of all kinds and meshes on all devices at one Poisson's ratio."""
    exact = motion("quadratic", _bar(finest), poisson, steps)[2]
    families = meshes(quick).items()
    runs = [
        Run(device, poisson, name, kind, mesh)
        for device in devices for name, each in families for kind, of in each.items() for mesh in of
    ]  # fmt: skip
    for run in [run for _ in range(rounds) for run in runs]:
        sim, records, paths = motion(run.kind, run.mesh, poisson, steps, run.device)
        mesh = sim.world.bodies[0].mesh
        run.tets, run.nodes = len(mesh.tets if mesh.quadratic is None else mesh.quadratic), sim.world.nodes
        run.blocks = len(sim.system.columns)
        run.milliseconds.append(1e3 * float(np.median(records["cpu" if run.device == "cpu" else "whole"])))
        run.iterations = float(records["iterations"].mean())
        run.error = float(np.sqrt(((paths - exact) ** 2).sum(axis=2).mean())) / LENGTH
        print(
            f"{run.device}, nu {poisson}, {run.family}, {run.kind} {run.tets}: {run.milliseconds[-1]:.3g} ms, "
            f"error {run.error:.1e}",
            flush=True,
        )
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


def answers(runs: list[Run], wanted: float) -> list[dict[str, Any]]:
    """By device, mesh and Poisson's ratio, what a step takes with each kind at an error."""
    found = []
    for where in dict.fromkeys((run.device, run.family, run.poisson) for run in runs):
        here = [run for run in runs if (run.device, run.family, run.poisson) == where]
        device, family, poisson = where
        times = {kind: time_at([run for run in here if run.kind == kind], wanted) for kind in CELLS}
        line: dict[str, Any] = {
            "device": device, "mesh": family, "ν": poisson, **{f"{kind}, ms": t for kind, t in times.items()},
        }  # fmt: skip
        best = min(((t, kind) for kind, t in times.items() if t is not None), default=(math.inf, "none"))
        slowest = max((float(np.median(run.milliseconds)) for run in here if run.kind == "linear"), default=math.nan)
        linear, line["cheapest"] = times["linear"], best[1]
        more = f"more than {slowest / best[0]:.3g}" if slowest > best[0] else None
        line["times cheaper than linear"] = linear / best[0] if linear else more
        found.append(line)
    return found


def diagram(runs: list[Run]) -> Any:
    """Error over milliseconds, a panel for each mesh and Poisson's ratio."""
    plt = plots()
    from matplotlib.ticker import LogLocator

    ratios, families = ([*dict.fromkeys(getattr(run, name) for run in runs)] for name in ("poisson", "family"))
    figure, axes = plt.subplots(len(families), len(ratios), figsize=(3.6 * len(ratios), 3.6 * len(families)),
                                sharex=True, sharey=True, squeeze=False, layout="constrained")  # fmt: skip
    for (family, poisson), axis in zip(product(families, ratios), axes.ravel(), strict=True):
        for kind in CELLS:
            line = [run for run in runs if (run.family, run.poisson, run.kind) == (family, poisson, kind)]
            axis.plot(
                [np.median(run.milliseconds) for run in line], [run.error for run in line], marker="o", label=kind
            )
        for wanted in WANTED:
            axis.axhline(wanted, color="gray", linewidth=0.8)
        axis.set(title=f"{family}, Poisson's ratio {poisson:g}", xscale="log", yscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
        axis.grid(True, which="both", alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("error of the motion / length")
    for axis in axes[-1]:
        axis.set_xlabel("ms a step")
    axes[0][0].legend()
    return figure


def main(
    end: Annotated[float, typer.Option(help="Simulated time of each run [s]")] = 1.0,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the kinds taking turns")] = 3,
    gpu: Annotated[bool, typer.Option("--gpu", help="On a GPU, too")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/elements]")] = None,
) -> None:
    """Error of the motion against the time of a step, for all kinds of elements."""
    assert set(CELLS) == set(get_args(Kind))
    finest, ratios = FINEST, list(SCHEMES)
    if quick:
        finest, ratios, end, rounds = 2, [0.45], 0.1, 1
    devices = ["cpu", "gpu"] if gpu else ["cpu"]
    report = Report("elements", "Kinds of elements", {"end": end, "rounds": rounds}, out, quick)
    runs = [run for poisson in ratios for run in measure(poisson, finest, round(end / 0.01), rounds, devices, quick)]
    report.say(HOW.format(finest=finest, four=4 * finest))
    for wanted in WANTED:
        report.say(f"## Time of a step at an error of {100 * wanted:g} %", BETWEEN)
        report.table(answers(runs, wanted))
    for device in devices:
        picture = diagram([run for run in runs if run.device == device])
        report.figure(picture, PICTURES[device], f"Error of the motion against the time of a step, {device}.")
    report.say("## Iterations with older factors", factors.HOW)
    boxes = {kind: _box(tets) for kind, tets in factors.TETS.items()}
    aged = factors.table(boxes, (0.45,) if quick else (0.3, 0.45, 0.499), 20 if quick else 150)
    report.table(aged)
    report.data["older factors"] = aged
    report.say("## All runs")
    report.table([run.table() for run in runs])
    report.data["runs"] = [vars(run) for run in runs]
    kept = [run.table() for run in runs if run.poisson == 0.45]
    report.remember(kept, ("device", "mesh", "elements", "tets"), ("ms a step",))
    report.write()


if __name__ == "__main__":
    typer.run(main)
