# SPDX-License-Identifier: MIT
"""One table of known answers: case, reference, ours, error, source of the reference; and errors on finer meshes."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from tests.bench.harness.report import Report, plots
from tests.bench.verification import actuation, bending, laws, locking, memory, motion, nafems, pores, static, tearing
from tests.bench.verification.row import Row

ABOUT = """\
Each line is computed when this page is made, by the simulation as it runs (CPU, float64).

- *error*: relative, or the difference where *of* says absolute; *at most* is what must hold, else the run fails.
- *limit of the meshes*: linear tetrahedra are too stiff in bending (they lock) by a part that falls with the square of
  the element's size; the limit is extrapolated from the last two meshes on that assumption. Lines marked *(locking)*
  are what the meshes themselves give. Where no kind of elements is named, they are linear ones of bars with
  `split = "kuhn"`, at whose diagonals locking shows most; with kinds named, bars are split as `mirrored` unless the
  line says otherwise.
- Static cases are scenes with `[integrator] scheme = "quasi_static"` and Newton-Raphson to 1e-8 of the first residual,
  loads by pushes. The slender beams (length 20 times the height) have exact tangents (`projection = "none"`), full
  Newton steps and their load in parts; the made-up solutions have a line search.
- Stresses at a point are those of the slopes, there, of polynomials of degree 4 that meet the displacements of nodes
  within 0.5 m (membrane) or 0.6 m (plate), and of their mirror images, as well as they can. That has an error of its
  own, of some percent, which finer meshes keep.
- Derivatives: random positions; where the law is defined there, some elements are turned inside out."""

STATIC: list[tuple[str, Callable[[list[int]], tuple[list[Row], static.Curves]], list[int], list[int]]] = [
    ("beams", static.beams, [2, 4, 8], [1, 2]),
    ("membrane", static.membrane, [4, 8, 16, 32], [4, 8, 16]),
    ("frequency", static.frequency, [2, 4, 6], [2, 4]),
    ("made up", static.made_up, [6, 12, 24], [3, 6]),
]
OTHERS = [
    laws.slopes, laws.patch, laws.uniaxial, motion.time_orders, motion.momentum, motion.energies,
    motion.preconditioners, *bending.CASES, nafems.stresses, memory.viscoelasticity, memory.plasticity,
    pores.poroelasticity, tearing.damage, *actuation.CASES,
]  # fmt: skip
LOCKING = """\
Sag of a clamped bar of 1 x 1 x 4 m under a small weight over what it should be, by Poisson's ratio: the mean of the
free face, over quadratic tetrahedra of an assembly of its own on a fine mesh. Each kind of `elements` in a scene; the
unstructured meshes are Gmsh's (tests/bench/verification/meshes)."""


def picture(curves: static.Curves) -> Any:
    """Error over the number of cells."""
    plt = plots()
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    for label, (meshes, errors) in curves.items():
        axis.loglog(meshes, errors, "o-", label=label)
    axis.set(xlabel="cells over the height (or the side)", ylabel="relative error")
    axis.grid(True, which="both", alpha=0.3)
    axis.legend(fontsize=7)
    return figure


def main(
    quick: Annotated[bool, typer.Option("--quick", help="A smoke run on coarse meshes")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/verification]")] = None,
) -> None:
    """Known answers: what must come out, and what did."""
    report = Report("verification", "Verification: known answers", {"meshes": "coarse" if quick else "all"}, out, quick)
    rows: list[Row] = []
    curves: static.Curves = {}
    for name, run, meshes, few in STATIC:
        began = time.perf_counter()
        found, more = run(few if quick else meshes)
        rows += found
        curves |= more
        print(f"{name}: {time.perf_counter() - began:.1f} s", flush=True)
    for case in OTHERS:
        began = time.perf_counter()
        rows += case(quick)
        print(f"{case.__name__}: {time.perf_counter() - began:.1f} s", flush=True)
    began = time.perf_counter()
    sags = locking.ratios(quick)
    rows += locking.rows(sags, quick)
    print(f"locking: {time.perf_counter() - began:.1f} s", flush=True)
    failed = [row.case for row in rows if not row.holds]
    report.say(ABOUT)
    report.table([row.cells() for row in rows])
    report.say("## Locking", LOCKING)
    report.table([{k: f"{v:.3f}" if isinstance(v, float) else v for k, v in line.items()} for line in sags])
    total = {"cases": len(rows), "that fail": len(failed), "sum of errors": sum(row.error for row in rows)}
    report.remember([total], (), tuple(total))
    report.data["rows"] = [vars(row) | {"holds": row.holds} for row in rows]
    report.data["sags"] = sags
    report.data["curves"] = {label: {"cells": m, "errors": e} for label, (m, e) in curves.items()}
    report.figure(picture(curves), "verification.png", "Errors on finer meshes: locking, and orders in space.")
    report.write()
    if failed:
        print(f"does not hold: {'; '.join(failed)}")
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
