# SPDX-License-Identifier: MIT
"""What every preconditioner costs and saves: bytes, time to make, time of an iteration, iterations.

The heterogeneous beam of deploy/scenes, let go from horizontal, at two sizes. Factors are as old as they would be from
a worker (lockstep, the deterministic twin of async), in the material frame. And what grabs cost that a factor does not
know, with and without the correction (grabs.py).
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from protocol.factor import Factor, FactorPattern
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_check import FactorCheck
from tests.bench.harness.report import Report, best_of, plots
from tests.bench.harness.schemes import SCENES
from tests.bench.preconditioners.grabs import WAYS, Hand, grab_row, short
from tests.bench.preconditioners.grabs import WORDS as WORDS_OF_GRABS

SIZES = {3150: (5, 5, 21), 24000: (10, 10, 40)}  # cells by number of tetrahedra
NAMES = ("none", "jacobi", "block_jacobi", "ssor", "ssor_factor", "incomplete_cholesky", "cholesky")
GRABS = (  # scene, cells, latencies, nodes, stiffnesses
    ("beam", (5, 5, 20), (1, 3), (1, 4, 16, 32, 64), (0.1, 1.0, 100.0, 1e4)),
    ("heterogeneous", (5, 5, 21), (3,), (1, 4, 16), (0.1, 1.0, 100.0, 1e4)),
    ("beam", (10, 10, 40), (3,), (16,), (0.1, 1.0)),
)
QUICK_GRABS = (("beam", (2, 2, 8), (2,), (4,), (1.0, 100.0)),)
WORDS = """\
*sent MB*: a factor as it travels, values in float32 and, where it changes with the matrix, its pattern; *make*: its
numeric factorization, the least of all; *iteration*: time of a solve over its iterations plus one, the least of all;
*solve*: median over the steps, the least of the rounds; *guard*: looking at a factor before it is used, the least of
ten, in the service thread. Least values are what the machine can do; what others did on it meanwhile is in the others.
The loop does nothing for a factor but apply it. Steps before the first factor are left out for all."""


@dataclass
class Found:
    """One preconditioner on one beam, gathered over rounds."""

    iterations: list[float] = field(default_factory=list)
    most: int = 0
    solve: list[float] = field(default_factory=list)  # ms
    each: list[float] = field(default_factory=list)  # ms, an iteration
    made: list[float] = field(default_factory=list)  # ms
    unconverged: int = 0
    sent: float = 0.0  # MB
    guard: float = 0.0  # ms

    def row(self, tets: int, name: str) -> dict[str, Any]:
        return {
            "tets": tets, "preconditioner": name, "sent MB": self.sent,
            "make ms": min(self.made, default=0.0),
            "iteration ms": min(self.each), "iterations": float(np.mean(self.iterations)),
            "most": self.most, "solve ms": min(self.solve), "guard ms": self.guard,
            "unconverged": self.unconverged, "repeats": len(set(self.iterations)) == 1,
        }  # fmt: skip


def pattern_bytes(pattern: FactorPattern) -> int:
    """As it travels."""
    return sum(a.nbytes for a in (pattern.permutation, pattern.super_start, pattern.row_start, pattern.rows))


def round_of(found: Found, name: str, cells: tuple[int, int, int], steps: int, latency: int) -> None:
    """One run added to what was found."""
    solver = {"preconditioner": f"'{name}'", "update": f"'lockstep-{latency}'", "max_iterations": 20_000}
    overrides = [f"solver.{key}={value}" for key, value in solver.items()]
    sim = Simulation.load(SCENES / "heterogeneous.toml", [*overrides, f"object.beam.mesh.bar={list(cells)}"])
    driver, factors = Driver(sim), list[Factor]()
    driver.on_adopt.append(factors.append)
    r = driver.advance(latency + steps)[latency:]
    found.iterations.append(float(r["iterations"].mean()))
    found.most = max(found.most, int(r["iterations"].max()))
    found.solve.append(1e3 * float(np.median(r["solve"])))
    found.each.append(1e3 * float((r["solve"] / (r["iterations"] + 1)).min()))
    found.unconverged += int((r["status"] != 0).sum())
    if not factors:
        return
    assert (r["factor_step"] >= 0).all(), "a step without a factor"
    found.made += [1e3 * f.seconds for f in factors]
    last, patterns = factors[-1], {f.pattern.id for f in factors}
    found.sent = 1e-6 * (last.values.nbytes + (pattern_bytes(last.pattern) if len(patterns) > 1 else 0))
    body = sim.world.bodies[0]
    sim.engine.assemble()
    matrix = sim.system.body_values(body.first, body.last)
    guard = FactorCheck({body.name: sim.system.body_pattern(body.first, body.last)})
    found.guard = 1e3 * best_of(10, lambda: guard.reject_reasons([(last, matrix)]))


def diagram(rows: list[dict[str, Any]]) -> Any:
    """Time of a solve against iterations, a mark for each preconditioner, a panel for each size."""
    sizes = list(dict.fromkeys(row["tets"] for row in rows))
    figure, axes = plots().subplots(1, len(sizes), figsize=(5.5 * len(sizes), 4.5), squeeze=False, layout="constrained")
    for axis, tets in zip(axes[0], sizes, strict=True):
        for row in (row for row in rows if row["tets"] == tets):
            axis.plot(row["iterations"], row["solve ms"], "o", label=row["preconditioner"])
        axis.set(title=f"{tets} tetrahedra", xlabel="iterations", xscale="log", yscale="log", ylabel="solve [ms]")
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].legend()
    return figure


def main(
    steps: Annotated[int, typer.Option(min=1, help="Steps of each run")] = 60,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the preconditioners taking turns")] = 3,
    latency: Annotated[int, typer.Option(min=1, help="D of lockstep-D: factors are D to 2 D - 1 steps old")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/preconditioners]")] = None,
) -> None:
    """Bytes, times and iterations of every preconditioner on the heterogeneous beam."""
    sizes = {192: (2, 2, 8)} if quick else SIZES
    if quick:
        steps, rounds = 6, 1
    arguments = {"steps": steps, "rounds": rounds, "latency": latency}
    report = Report("preconditioners", "What every preconditioner costs and saves", arguments, out, quick)
    rows = []
    for tets, cells in sizes.items():
        found = {name: Found() for name in NAMES}
        for _ in range(rounds):
            for name, one in found.items():
                round_of(one, name, cells, steps, latency)
        rows += [one.row(tets, name) for name, one in found.items()]
        print(f"{tets} tetrahedra done", flush=True)
    report.data["rows"] = rows
    report.remember(rows, ("tets", "preconditioner"), ("iterations", "solve ms"))
    report.say(
        f"deploy/scenes/heterogeneous.toml (1000:50:10), dt 20 ms, tolerance 1e-6, one thread, lockstep-{latency}."
    )
    report.figure(diagram(rows), "preconditioners.png", "Time of a solve and its iterations.")
    report.table(rows)
    report.say(WORDS)
    grabs = [
        grab_row(scene, cells, d, Hand(nodes, stiffness), rounds)
        for scene, cells, latencies, counts, many in (QUICK_GRABS if quick else GRABS)
        for d in latencies
        for nodes in counts
        for stiffness in many
    ]
    report.data["grabs"] = grabs
    report.say("## Grabs", f"Iterations: {' / '.join(WAYS)}.")
    report.table(short(grabs))
    report.say(WORDS_OF_GRABS)
    report.write()


if __name__ == "__main__":
    typer.run(main)
