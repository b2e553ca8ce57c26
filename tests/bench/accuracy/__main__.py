# SPDX-License-Identifier: MIT
"""What accuracy costs: error of the positions against time per step, over tolerances of the linear solver.

The error is against the same scene solved to 1e-12, so it is that of the linear solves alone: mesh, time step and
linearization are the same on both sides. The reference is made by a method that is not compared (block Jacobi): PCG-1
would agree with a reference of its own to the last bit at any tolerance, since its one iteration is the same. How far
two independent runs at 1e-12 are apart is the floor: an error at or below it says only "not larger than this".
"""

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sim_server.simulation import Simulation
from tests.bench.harness.report import Report, plots
from tests.bench.harness.schemes import SCENES, Run, Scheme, run

REFERENCE = Scheme("reference", ("preconditioner=block_jacobi",))
FRESH = ("preconditioner=cholesky", "update=every-1", "factor_precision=float64")
MANY = ("solver.max_iterations=100000",)
ERRORS = """\
A step counts as solved when the true residual satisfies |b - A dv| <= tolerance |b|. Error: distance of every node at
every step from where it is in a run at 1e-12 (block Jacobi, which is not among the methods), largest and root mean
square, over the length of the beam. Mesh, dt = 0.02 s and the one linearization per step are the same on both sides:
this is the error of the linear solves and nothing else. Floor: how far a second run at 1e-12 (PCG-1) is from the
reference; PCG-1 lands there at every tolerance, since its one iteration solves to rounding."""
BEAMS = {"homogeneous": "beam.toml", "heterogeneous 1000:50:10": "heterogeneous.toml"}


def _times(latency: int, processes: bool) -> str:
    real = "is sim-server with one worker process, running freely on the same cores" if processes else "was left out"
    return f"""\
Time: wall time of a step. PCG-1 factorizes in the step (float64) and its time includes that. async+warp has a float32
factor from a worker: lockstep-{latency} is its deterministic twin, whose factor is {latency} to {2 * latency - 1} steps
old (made between the steps, not counted; none in the first {latency} steps, block Jacobi until then). *real* {real};
it has no factor until the worker's first. All steps count; "steps without" are those without a factor."""


def schemes(latency: int, processes: bool) -> list[Scheme]:
    """In the order of the legend."""
    factor = "preconditioner=cholesky"
    found = [
        Scheme("CG", ("preconditioner=none",)),
        Scheme("Jacobi", ("preconditioner=jacobi",)),
        Scheme("PCG-1", FRESH),
        Scheme(f"async+warp, lockstep-{latency}", (factor, f"update=lockstep-{latency}", "warp=true")),
    ]
    real = Scheme("async+warp, real", (factor, "update=async", "warp=true"), processes=True)
    return [*found, real] if processes else found


@dataclass
class Point:
    """One scheme at one tolerance, gathered over rounds."""

    beam: str
    scheme: str
    tolerance: float
    floor: float  # of the error that can be told, / length
    worst: list[float] = field(default_factory=list)  # largest error / length
    rms: list[float] = field(default_factory=list)
    median: list[float] = field(default_factory=list)  # ms per step
    p99: list[float] = field(default_factory=list)
    iterations: list[float] = field(default_factory=list)
    age: list[float] = field(default_factory=list)  # mean, steps
    without: list[float] = field(default_factory=list)  # steps without a factor
    unconverged: int = 0

    def add(self, result: Run, reference: Run, length: float) -> None:
        distance = _distance(result, reference, length)
        self.worst.append(float(distance.max()))
        self.rms.append(float(np.sqrt((distance**2).mean())))
        self.median.append(1e3 * float(np.median(result.seconds)))
        self.p99.append(1e3 * float(np.percentile(result.seconds, 99)))
        self.iterations.append(float(result.iterations.mean()))
        known = np.isfinite(result.age)
        self.age.append(float(result.age[known].mean()) if known.any() else float("nan"))
        self.without.append(float((~known).sum()))
        self.unconverged += sum(s != "converged" for s in result.status)

    def row(self) -> dict[str, Any]:
        """Medians over the rounds, with their range for the time."""
        return {
            "method": self.scheme,
            "tolerance": f"{self.tolerance:.0e}",
            "max error / L": self._known(np.median(self.worst)),
            "rms error / L": f"{np.median(self.rms):.1e}",
            "ms per step, median": float(np.median(self.median)),
            "range over rounds": f"{min(self.median):.3g} … {max(self.median):.3g}",
            "p99": float(np.median(self.p99)),
            "iterations": float(np.median(self.iterations)),
            "factor age": float(np.median(self.age)),
            "steps without": float(np.median(self.without)),
            "unconverged": self.unconverged,
        }

    def _known(self, error: Any) -> str:
        return f"{error:.1e}" if error > 2 * self.floor else f"≤ floor ({error:.1e})"


def _distance(a: Run, b: Run, length: float) -> Any:
    return np.linalg.norm(a.x - b.x, axis=2) / length


def measure(
    report: Report, kinds: list[Scheme], tolerances: list[float], steps: int, rounds: int, mesh: tuple[str, ...]
) -> list[Point]:
    """All points; the methods take turns within a round, so that a drifting machine hits them alike."""
    points: dict[tuple[str, str, float], Point] = {}
    with tempfile.TemporaryDirectory() as folder:
        for beam, file in BEAMS.items():
            more = (*MANY, *mesh)
            reference = run(SCENES / file, REFERENCE, steps, (*more, "solver.tolerance=1e-12"))
            rest = Simulation.load(SCENES / file, list(more)).world.rest
            length = float(np.ptp(rest, axis=0).max())
            second = run(SCENES / file, Scheme("second reference", FRESH), steps, (*more, "solver.tolerance=1e-12"))
            floor = float(_distance(second, reference, length).max())
            assert floor > 0, "the two references are the same computation"
            report.data[f"{beam}: reference"] = {**_reached(reference), "floor": floor}
            for _, tolerance, kind in itertools.product(range(rounds), tolerances, kinds):
                point = points.setdefault((beam, kind.name, tolerance), Point(beam, kind.name, tolerance, floor))
                result = run(SCENES / file, kind, steps, (*more, f"solver.tolerance={tolerance:g}"), Path(folder))
                point.add(result, reference, length)
                print(f"{beam}, {kind.name}, {tolerance:.0e}: {point.median[-1]:.3g} ms, error {point.worst[-1]:.1e}")
    return list(points.values())


def _reached(reference: Run) -> dict[str, Any]:
    return {
        "largest true residual": float(reference.residual.max()),
        "largest displacement": float(np.linalg.norm(reference.x - reference.x[0], axis=2).max()),
        "status": sorted(set(reference.status)),
    }


def _lines(points: list[Point], beam: str) -> Iterator[tuple[str, list[Point]]]:
    for name in dict.fromkeys(p.scheme for p in points):
        yield name, [p for p in points if p.scheme == name and p.beam == beam]


def diagram(points: list[Point]) -> Any:
    """Work against precision, one panel per beam."""
    plt = plots()
    figure, axes = plt.subplots(1, len(BEAMS), figsize=(12, 5), sharex=True, sharey=True, layout="constrained")
    for axis, beam in zip(axes, BEAMS, strict=True):
        for name, line in _lines(points, beam):
            middle = np.array([np.median(p.median) for p in line])
            spread = [middle - [min(p.median) for p in line], [max(p.median) for p in line] - middle]
            axis.errorbar([np.median(p.worst) for p in line], middle, yerr=spread, marker="o", capsize=2, label=name)
        axis.axvline(line[0].floor, color="0.5", ls=":", label="floor: two references apart")
        axis.set(title=beam, xlabel="largest error of a position / length of the beam", xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("time per step, median [ms]")
    axes[0].legend()
    return figure


def main(
    steps: Annotated[int, typer.Option(min=1, help="Steps of each run")] = 100,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the methods taking turns")] = 3,
    latency: Annotated[int, typer.Option(min=1, help="D of lockstep-D, the deterministic twin of async")] = 10,
    processes: Annotated[bool, typer.Option(help="Also with a real worker process")] = True,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/accuracy]")] = None,
) -> None:
    """Error of the positions against time per step, for tolerances of 1e-2 to 1e-10."""
    tolerances = [10.0**-k for k in range(2, 11)]
    mesh: tuple[str, ...] = ()
    if quick:
        steps, rounds, tolerances, latency, mesh = 8, 1, [1e-2, 1e-6], 3, ("object.beam.mesh.bar=[2, 2, 6]",)
    arguments = {"steps": steps, "rounds": rounds, "latency": latency, "processes": processes, "tolerances": tolerances}
    report = Report("accuracy", "What accuracy costs in time", arguments, out, quick)
    points = measure(report, schemes(latency, processes), tolerances, steps, rounds, mesh)
    if not all(error > 0 for point in points for error in point.worst):
        raise SystemExit("bench accuracy: no error at all: a method was its own reference")
    report.say(ERRORS, _times(latency, processes))
    report.figure(diagram(points), "accuracy.png", "Work against precision; bars: range of medians over the rounds.")
    for beam in BEAMS:
        reached = report.data[f"{beam}: reference"]
        report.say(
            f"## {beam}",
            f"Reference: largest true residual {reached['largest true residual']:.1e}, floor {reached['floor']:.1e}; "
            f"the beam moves by up to {reached['largest displacement']:.3g} m; status {', '.join(reached['status'])}.",
        )
        report.table([p.row() for p in points if p.beam == beam])
    report.data["points"] = [vars(p) for p in points]
    usual = [{"beam": p.beam, **p.row()} for p in points if p.tolerance == 1e-6]
    report.remember(usual, ("beam", "method"), ("ms per step, median", "iterations"))
    report.write()


if __name__ == "__main__":
    typer.run(main)
