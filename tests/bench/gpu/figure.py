# SPDX-License-Identifier: MIT
"""The picture of the GPU benchmark: time of a step against size."""

from typing import Any

from tests.bench.gpu.problem import AIMS, MATERIALS
from tests.bench.harness.report import Report, plots

Row = dict[str, Any]
OURS = {"us p50": ("factor", "C0"), "CG us": ("CG", "C1"), "block Jacobi us": ("block Jacobi", "C2")}


def figure(report: Report, single: list[Row], others: list[Row]) -> None:
    """single: rows of one beam, of which those of the card with most are drawn; others: rows of others' solvers."""
    cards = [row["gpu"] for row in single]
    card = max(cards, key=cards.count)
    single, others = ([row for row in rows if row["gpu"] == card] for rows in (single, others))
    drawing, axes = plots().subplots(figsize=(7.5, 5), layout="constrained")

    def line(points: list[tuple[float, float | None]], style: str, label: str, **more: Any) -> None:
        known = [(x, y) for x, y in points if y]
        if known:
            axes.loglog(*zip(*known, strict=True), style, label=label, ms=4, **more)

    for material, style in zip(MATERIALS, ("o-", "o--"), strict=True):
        mine = [r for r in single if r["material"] == material]
        for key, (label, colour) in OURS.items():
            line([(r["tets"], r.get(key)) for r in mine], style, f"{label}, {material}", color=colour)
    direct = [r for r in others if r["what"] == "cuDSS, float64" and r["material"] == MATERIALS[0]]
    line([(r["tets"], r.get("us")) for r in direct], "s-", "cuDSS each step, homogeneous", color="C3")
    aims = [(tets, aim) for (beams, tets), aim in AIMS.items() if beams == 1]
    line([(tets, aim.aim) for tets, aim in aims], "k:", "aim, homogeneous")
    line([(tets, aim.paper) for tets, aim in aims], "k^", "Courtecuisse et al. 2010, GTX 480")
    axes.set(xlabel="tetrahedra", ylabel=f"us per step, {card}")
    axes.legend(fontsize=8)
    report.figure(drawing, "gpu.png", "Median time of a step against size")
