# SPDX-License-Identifier: MIT
"""The page of bench contact: a section for each part that there are rows of."""

from tests.bench.contact import passes, picture, words
from tests.bench.contact.bodies import FACTOR, Row
from tests.bench.harness.report import Report, plots

Tables = dict[str, list[Row]]
COLOURS = {"factor": "k", "first factor": "C1", "block Jacobi": "C0"}


def write(report: Report, tables: Tables) -> None:
    """Page, pictures and JSON. tables: rows by the name of their table."""
    report.data |= {name: rows for name, rows in tables.items() if rows}
    report.say(words.SETUP)
    shown = {
        "stairs": _stairs, "answers": _answers, "wall": _wall, "hertz": _hertz, "belt": _belt, "paths": _paths,
        "passes": _passes, "cost": _cost, "few": _few, "impact": _impact, "goals": _goals, "own": _own,
    }  # fmt: skip
    for name, show in shown.items():
        if rows := tables.get(name, []):
            show(report, rows)
    report.write()


def _stairs(report: Report, rows: list[Row]) -> None:
    row, plt = rows[0], plots()
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", width_ratios=(3, 2))
    picture.draw(axes[0], row)
    for name, style in (("iterations", "C0-"), ("contacts", "C2-"), ("passes", "C3-")):
        axes[1].plot(row["time"], row[name], style, label=name, lw=1)
    axes[1].set(xlabel="time [s]")
    axes[1].legend()
    axes[1].grid(True, alpha=0.3)
    report.figure(figure, "contact.png", words.STAIRS)


def _answers(report: Report, rows: list[Row]) -> None:
    report.say("## Known answers", words.ANSWERS)
    report.table(rows)
    total = {"cases": len(rows), "that fail": sum(row["holds"] == "**no**" for row in rows)}
    report.remember([total], (), tuple(total))


def _wall(report: Report, rows: list[Row]) -> None:
    plt = plots()
    figure, axis = plt.subplots(figsize=(6, 3.4), layout="constrained")
    for row in rows:
        axis.plot(row["time over 2 L/c"], row["force over rho c v S"], label=f"{row['cells']} cells along the bar")
    axis.plot([0, 0, 1, 1], [0, 1, 1, 0], "k:", label="one dimension")
    axis.set(xlabel="time from the impact over 2 L / c", ylabel="force over rho c v S")
    axis.legend(fontsize=8)
    axis.grid(True, alpha=0.3)
    report.say("## A bar against a wall", words.WALL)
    report.figure(figure, "contact_wall.png", "Force of a bar on a wall.")


def _hertz(report: Report, rows: list[Row]) -> None:
    report.say("## Hertz", words.HERTZ)
    rows = sorted(rows, key=lambda row: row["tets"])
    report.table(rows)
    report.remember(rows[-1:], ("tets", "depth mm"), ("force over Hertz",))


def _belt(report: Report, rows: list[Row]) -> None:
    report.say("## A belt round a cylinder", words.BELT)
    report.table(rows)
    report.remember(rows, ("friction",), ("T1 / T2",))


def _paths(report: Report, rows: list[Row]) -> None:
    report.say("## Nodes on the wrong side", words.PATHS)
    found: dict[tuple[str, float], Row] = {}
    for row in rows:
        line = found.setdefault((row["obstacle"], row["dt ms"]), {"obstacle": row["obstacle"], "dt ms": row["dt ms"]})
        line[f"{row['speed']:g} m/s"] = f"{row['wrong']}" + (f" ({row['clipped']})" if row["clipped"] else "")
    report.table(list(found.values()))
    total = {"runs": len(rows), "with nodes on the wrong side": sum(row["wrong"] > 0 for row in rows)}
    report.table([total])
    report.remember([total], (), ("with nodes on the wrong side",))


def _passes(report: Report, rows: list[Row]) -> None:
    report.say("## Passes", words.PASSES)
    report.table([*rows, {"passes, at most": "rigid"} | passes.rigid()])


def _cost(report: Report, rows: list[Row]) -> None:
    report.say("## Cost of a step", words.COST)
    rows = sorted(rows, key=lambda row: (row["tets"], row["kappa"]))
    for key in dict.fromkeys((row["tets"], row["kappa"]) for row in rows):
        mine = [row for row in rows if (row["tets"], row["kappa"]) == key]
        report.say(f"### {key[0]:,} tetrahedra, kappa {key[1]:g}")
        report.table(mine, [name for name in mine[0] if name not in ("tets", "kappa")])
    kept = [row for row in rows if row["kappa"] == 1 and row["preconditioner"] == FACTOR]
    report.remember(kept, ("tets", "situation"), ("iterations", "p50 ms"))


def _few(report: Report, rows: list[Row]) -> None:
    report.say("## A few contacts", words.FEW)
    rows = sorted(rows, key=lambda row: (row["nodes"], row["body"], row["kappa"], row["lockstep"]))
    report.table(rows)
    report.remember(rows, ("body", "nodes", "kappa", "lockstep", "preconditioner"), ("iterations", "mean ms"))


def _impact(report: Report, rows: list[Row]) -> None:
    plt = plots()
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for row in rows:
        for axis, name in zip(axes, ("iterations", "ms"), strict=True):
            values = [max(value, 0.5) if name == "iterations" else value for value in row[name]]
            axis.semilogy(row["step"], values, "o-", ms=3, color=COLOURS[row["preconditioner"]],
                          label=row["preconditioner"])  # fmt: skip
    axes[0].set(xlabel="step", ylabel="iterations of a step (0 drawn as 0.5)")
    axes[1].set(xlabel="step", ylabel="processor time of a step [ms]")
    axes[0].legend(fontsize=8)
    for axis in axes:
        axis.grid(True, which="both", alpha=0.3)
    report.say("## An impact, step by step", words.IMPACT)
    report.figure(figure, "contact_impact.png", f"An impact without friction, {rows[0]['tets']:,} tetrahedra.")


def _goals(report: Report, rows: list[Row]) -> None:
    report.say("## What was aimed at", words.GOALS)
    report.table(rows)


def _own(report: Report, rows: list[Row]) -> None:
    report.say("## The effect itself", words.OWN)
    report.table(rows)
    report.remember(rows, ("case",), ("p50 ms",))
