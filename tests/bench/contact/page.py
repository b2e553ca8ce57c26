# SPDX-License-Identifier: MIT
"""The page of bench contact: a section for each part that there are rows of."""

from collections.abc import Callable
from typing import Any

from tests.bench.contact import impact, ladder, passes, peers, picture, summary, words
from tests.bench.contact.bodies import FACTOR, SITUATIONS, Row
from tests.bench.harness.report import Report, plots

Tables = dict[str, list[Row]]
COLOURS = {
    "factor": "k", impact.UNCORRECTED: "0.6", impact.NONE_IN_CONTACT: "C2", "first factor": "C1", "block Jacobi": "C0"
}  # fmt: skip


def write(report: Report, tables: Tables) -> None:
    """Page, pictures and JSON. tables: rows by the name of their table."""
    tables = {name: ordered(name, rows) for name, rows in tables.items()}
    report.data |= {name: rows for name, rows in tables.items() if rows}
    if found := summary.rows(tables):
        report.say(words.SHORT)
        report.table(found)
    report.say(words.SETUP)
    shown = {
        "stairs": _stairs, "answers": _answers, "paths": _paths, "goals": _goals, "impact": _impact, "own": _own,
        "itself": _itself, "pile": _pile, "peers": _peers, "wall": _wall, "hertz": _hertz, "belt": _belt,
        "passes": _passes, "cost": _cost, "few": _few,
    }  # fmt: skip
    for name, show in shown.items():
        if rows := tables.get(name, []):
            show(report, rows)
    report.write()


def ordered(name: str, rows: list[Row]) -> list[Row]:
    """Rows of a table, which pieces may have in any order."""
    by = ORDER.get(name)
    return sorted(rows, key=by) if by else rows


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
    for key in dict.fromkeys((row["device"], row["tets"], row["kappa"]) for row in rows):
        mine = [row for row in rows if (row["device"], row["tets"], row["kappa"]) == key]
        report.say(f"### {key[1]:,} tetrahedra, kappa {key[2]:g}{_where(key[0])}")
        report.table(mine, [name for name in mine[0] if name not in ("device", "tets", "kappa")])
    kept = [row for row in rows if row["kappa"] == 1 and row["preconditioner"] == FACTOR]
    report.remember(kept, ("device", "tets", "situation"), ("iterations", "p50 ms"))


def _few(report: Report, rows: list[Row]) -> None:
    report.say("## A few contacts", words.FEW)
    report.table(rows)
    key = ("device", "body", "nodes", "contacts", "kappa", "lockstep", "preconditioner")
    report.remember(rows, key, ("iterations", "mean ms"))


def _where(device: str) -> str:
    """What a title says of it."""
    return "" if device == "cpu" else ", on a GPU"


def _impact(report: Report, rows: list[Row]) -> None:
    report.say("## An impact, step by step", words.IMPACT)
    drawn = [row for row in rows if row["device"] == rows[0]["device"] and row["tets"] == rows[0]["tets"]]
    plt = plots()
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for row in drawn:
        for axis, name in zip(axes, ("iterations", "ms"), strict=True):
            values = [max(value, 0.5) if name == "iterations" else value for value in row[name]]
            axis.semilogy(row["step"][:SHOWN], values[:SHOWN], "o-", ms=3, color=COLOURS[row["preconditioner"]],
                          label=row["preconditioner"])  # fmt: skip
    axes[0].set(xlabel="step", ylabel="iterations of a step (0 drawn as 0.5)")
    axes[1].set(xlabel="step", ylabel="time of a step [ms]")
    axes[0].legend(fontsize=8)
    for axis in axes:
        axis.grid(True, which="both", alpha=0.3)
    report.figure(figure, "contact_impact.png", f"An impact without friction, {drawn[0]['tets']:,} tetrahedra.")
    for key in dict.fromkeys((row["device"], row["tets"]) for row in rows):
        mine = [line for row in rows if (row["device"], row["tets"]) == key for line in impact.phases(row)]
        report.say(f"### Impact of {key[1]:,} tetrahedra{_where(key[0])}")
        report.table(sorted(mine, key=lambda line: ("before", "at", "after").index(line["impact"])))


def _goals(report: Report, rows: list[Row]) -> None:
    report.say("## What was aimed at", words.GOALS)
    report.table(rows)


def _own(report: Report, rows: list[Row]) -> None:
    report.say("## The effect itself", words.OWN)
    report.table(rows)
    report.remember(rows, ("device", "case"), ("p50 ms",))


def _itself(report: Report, rows: list[Row]) -> None:
    report.say("## Bodies that touch themselves", words.ITSELF)
    report.table(rows)


def _pile(report: Report, rows: list[Row]) -> None:
    report.say("## A pile", words.PILE)
    report.table(rows)
    report.remember(rows, ("device", "bodies"), ("rest: p50 ms",))


def _peers(report: Report, rows: list[Row]) -> None:
    report.say("## Beside others", words.PEERS)
    there = {row["who"] for row in rows}
    if left_out := sorted({way.who for way in peers.WAYS} - there):
        report.say(f"Not measured here: {', '.join(left_out)}.")
    for title, columns in PEERS.items():
        report.say(f"### {title}")
        report.table(_beside(rows, columns))
    ours = [row for row in rows if row["who"] == peers.OURS and row["settings"] == "default"]
    report.remember(ours, ("device", "case"), ("ms a frame",))


def _beside(rows: list[Row], columns: dict[str, tuple[str, str]]) -> list[Row]:
    """A line for each way; columns: case and its column by the name in this table."""
    found: dict[tuple[str, ...], Row] = {}
    for row in rows:
        key = (row["who"], row["settings"], row["device"])
        line = found.setdefault(key, {"by": row["who"], "settings": row["settings"], "device": row["device"]})
        line |= {name: row[of] for name, (case, of) in columns.items() if case == row["case"] and of in row}
    names = ("by", "settings", "device", *columns)
    return [{name: line.get(name) for name in names} for line in found.values()]


def _phase(row: Row) -> tuple[int, int]:
    """Of a row of the cost of a step: its situation, and the part of the impact."""
    situation, _, phase = row["situation"].partition(", ")
    return [each.name for each in SITUATIONS].index(situation), ("", "before", "at", "after").index(phase)


WAYS = [(way.who, way.name) for way in peers.WAYS]
ORDER: dict[str, Callable[[Row], Any]] = {
    "hertz": lambda row: (row["tets"], row["depth mm"]),
    "belt": lambda row: row["friction"],
    "paths": lambda row: (list(ladder.OBSTACLES).index(row["obstacle"]), row["dt ms"], row["speed"]),
    "passes": lambda row: row["passes, at most"],
    "cost": lambda row: (row["device"], row["tets"], row["kappa"], _phase(row)[0], list(COLOURS).index(row[SOLVER]),
                         _phase(row)[1]),
    "few": lambda row: (row["device"], row["nodes"], row["body"], row["kappa"], row["contacts"], row["lockstep"]),
    "impact": lambda row: (row["device"], row["tets"], impact.WAYS.index(row[SOLVER])),
    "goals": lambda row: (row["device"], row["bodies"], row["contacts"] > 50, row["goal"]),
    "own": lambda row: row["device"],
    "pile": lambda row: (row["device"], row["bodies"]),
    "peers": lambda row: (row["device"], WAYS.index((row["who"], row["settings"]))),
}  # fmt: skip
SOLVER = "preconditioner"
SHOWN = 40  # steps in the picture of the impact
_DROP, _SLIDE, _FREE = peers.DROP.name, peers.SLIDE.name, peers.FREE.name
_STEEP, _FLAT, _STACK = peers.STEEP.name, peers.FLAT.name, peers.STACK.name
PEERS: dict[str, dict[str, tuple[str, str]]] = {
    "Friction": {
        "stop m": (_SLIDE, "stop m"), "known m": (_SLIDE, "known m"), "error": (_SLIDE, "error"),
        "creep at -5 degrees mm/s": (_FLAT, "creep mm/s"), "creep at -0.5 degrees mm/s": (_STEEP, "creep mm/s"),
        "speed without friction m/s": (_FREE, "speed m/s"), "known m/s": (_FREE, "known m/s"),
    },
    "Penetration": {
        "drop: deepest mm": (_DROP, "deepest mm"), "at rest mm": (_DROP, "at rest mm"),
        "force on the floor over weight": (_DROP, "floor / weight"), "stack: floor mm": (_STACK, "floor mm"),
        "between blocks mm": (_STACK, "between mm"), "creep of the top mm/s": (_STACK, "creep of the top mm/s"),
        "stands": (_STACK, "stands"),
    },
    "Time": {
        "dt ms": (_DROP, "dt ms"), "drop: ms a step": (_DROP, "ms a step"), "ms a frame": (_DROP, "ms a frame"),
        "most ms a frame": (_DROP, "most ms a frame"), "the loop alone": (_DROP, "loop ms a frame"),
        "slide: ms a frame": (_SLIDE, "ms a frame"),
        "stack: ms a step": (_STACK, "ms a step"), "stack: ms a frame": (_STACK, "ms a frame"),
        "version": (_DROP, "version"), "warnings": (_DROP, "notes"),
    },
}  # fmt: skip
