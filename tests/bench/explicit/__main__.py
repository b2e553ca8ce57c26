# SPDX-License-Identifier: MIT
"""Where implicit steps begin to pay: explicit substeps beside backward Euler and Newmark, over stiffness and mesh.

All move the same beam for the same time, in turns. The reference is the explicit scheme with substeps of a fifth of the
stable step, so errors have those of the time step, of the linearization and of the solves, but not of the mesh.
"""

from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.report import Report, plots
from tests.bench.harness.schemes import SCENES

DT = 0.02  # s, between frames
FINER = 5  # substeps of the reference in a stable step
EXPLICIT = ("integrator.scheme=central_difference",)
FACTOR = ("solver.preconditioner=cholesky", "solver.update=lockstep-4")
METHODS: dict[str, tuple[float, tuple[str, ...]]] = {
    "explicit, dt 20 ms": (DT, EXPLICIT),
    "backward Euler, 20 ms": (DT, FACTOR),
    "backward Euler, 5 ms": (DT / 4, FACTOR),
    "Newmark, 5 ms": (DT / 4, ("integrator.scheme=newmark", *FACTOR)),
}
HOW = """\
The beam of beam.toml (1 x 1 x 4 m, corotational, Poisson's ratio 0.45, let go from horizontal). Seconds: time of the
steps over the time simulated, median over the rounds; factors are exact ones from the matrix of 4 to 7 steps before,
made between the steps and not counted: of a server, a worker on another core makes them. Explicit substeps need no
worker. Error: largest distance of a node at the end of any step of 20 ms from where it is in the reference, over the
length. The reference has explicit substeps of a fifth of the stable step. Away: steps in which a body ran away; an
error is then that of a frozen body. Implicit begins to pay where its seconds fall below those of explicit substeps at
an error that will do."""

Frames = NDArray[np.float64]


@dataclass
class Row:
    """One method on one mesh at one stiffness, over rounds."""

    cells: list[int]
    tets: int
    young: float
    method: str
    seconds: list[float] = field(default_factory=list)  # per simulated second
    error: float = 0.0  # over the length
    inner: float = 0.0  # substeps, or iterations, of 20 ms
    away: int = 0

    def table(self) -> dict[str, Any]:
        return {
            "tets": self.tets, "young": f"{self.young:.0e}", "method": self.method,
            "s per simulated s": float(np.median(self.seconds)),
            "range": f"{min(self.seconds):.3g} … {max(self.seconds):.3g}",
            "error / L": f"{self.error:.1e}", "substeps or iterations": self.inner, "away": self.away,
        }  # fmt: skip


def motion(
    cells: list[int], young: float, dt: float, more: tuple[str, ...], end: float, device: str
) -> tuple[Any, Frames, int]:
    """Returns the records, the positions each 20 ms, and the number of elements."""
    keys = [f"object.beam.mesh.bar={cells}", f"object.beam.effects.corotational.young={young:g}", f"dt={dt!r}", *more]
    sim = Simulation.load(SCENES / "beam.toml", keys, device)
    driver, records, frames = Driver(sim), [], []
    each = round(DT / dt)
    for _ in range(round(end / DT)):
        records.append(driver.advance(each))
        frames.append(sim.fetch().x.copy())
    return np.concatenate(records), np.array(frames), len(sim.world.bodies[0].mesh.tets)


def reference(cells: list[int], young: float, end: float) -> Frames:
    """Positions each 20 ms with short explicit substeps."""
    first, _, _ = motion(cells, young, DT, EXPLICIT, DT, "cpu")
    dt = DT / float(np.ceil(FINER * DT / first["stable_step"].min()))
    return motion(cells, young, dt, EXPLICIT, end, "cpu")[1]


def measure(cells: list[int], young: float, end: float, rounds: int, device: str) -> list[Row]:
    """Rows of all methods, which take turns."""
    exact, rows = reference(cells, young, end), {}
    for _, (name, (dt, more)) in product(range(rounds), METHODS.items()):
        r, x, tets = motion(cells, young, dt, more, end, device)
        row = rows.setdefault(name, Row(cells, tets, young, name))
        row.seconds.append(float(r["whole"].sum()) / end)
        row.error = float(np.linalg.norm(x - exact, axis=2).max()) / 4
        inner = r["substeps"] if r["substeps"].any() else r["iterations"]
        row.inner, row.away = float(inner.sum() / len(exact)), int((r["status"] == pb.RUNAWAY).sum())
        print(f"{tets} tets, E {young:.0e}, {name}: {row.seconds[-1]:.3g} s, error {row.error:.1e}", flush=True)
    return list(rows.values())


def diagram(rows: list[Row]) -> Any:
    """Seconds over Young's modulus, one panel per mesh."""
    plt = plots()
    meshes = list(dict.fromkeys(row.tets for row in rows))
    figure, axes = plt.subplots(1, len(meshes), figsize=(4.5 * len(meshes), 4.5), squeeze=False, layout="constrained")
    for axis, tets in zip(axes[0], meshes, strict=True):
        for name in METHODS:
            line = [row for row in rows if row.tets == tets and row.method == name]
            axis.plot([row.young for row in line], [np.median(row.seconds) for row in line], marker="o", label=name)
        axis.set(title=f"{tets} tetrahedra", xlabel="Young's modulus [Pa]", xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].set_ylabel("seconds per simulated second")
    axes[0][0].legend()
    return figure


def main(
    end: Annotated[float, typer.Option(help="Simulated time of each run [s]")] = 1.0,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the methods taking turns")] = 3,
    device: Annotated[str, typer.Option(help="Of all methods: cpu or gpu; the reference is made on a cpu")] = "cpu",
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/explicit]")] = None,
) -> None:
    """Cost and error of explicit substeps and implicit steps over stiffness and mesh."""
    meshes, stiffness = [[2, 2, 8], [5, 5, 20], [10, 10, 40]], [1e4, 1e5, 1e6, 1e7]
    if quick:
        end, rounds, meshes, stiffness = 0.1, 1, [[1, 1, 4]], [1e5, 1e6]
    arguments = {"end": end, "rounds": rounds, "device": device, "meshes": meshes, "stiffness": stiffness}
    report = Report("explicit", "Explicit and implicit steps", arguments, out, quick)
    rows = [row for cells, young in product(meshes, stiffness) for row in measure(cells, young, end, rounds, device)]
    report.say(HOW)
    report.figure(diagram(rows), "explicit.png", "Cost of a simulated second over stiffness.")
    report.table([row.table() for row in rows])
    report.data["rows"] = [vars(row) for row in rows]
    usual = [row.table() for row in rows if row.tets == 3000 and row.young == 1e6]
    report.remember(usual, ("tets", "method"), ("s per simulated s", "substeps or iterations"))
    report.write()


if __name__ == "__main__":
    typer.run(main)
