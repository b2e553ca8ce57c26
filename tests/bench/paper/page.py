# SPDX-License-Identifier: MIT
"""The page of bench paper: a section for each table that there are rows of."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.bench.figure4 import figure as figure4
from tests.bench.harness.report import Report
from tests.bench.harness.schemes import Run
from tests.bench.paper import words
from tests.bench.paper.beam import BANDS, LOADS
from tests.bench.paper.publishing import STRETCH
from tests.bench.paper.tables import Row, Setting
from tests.bench.paper.units import KEYS

Tables = dict[str, list[Row]]


def write(report: Report, setting: Setting, tables: Tables) -> None:
    """Page, picture and JSON. tables: rows by the name of their table."""
    report.data |= {name: rows for name, rows in tables.items() if rows}
    report.say(*words.explained(setting))
    report.remember(tables.get("table1", []), ("device", "tets"), ("iterations", "step ms"))
    warped = [row for row in tables.get("table2", []) if row["scheme"] == "async + warp"]
    report.remember(warped, ("device", "load", "model"), ("iterations", "step ms"))
    for device in ("cpu", "gpu"):
        mine = {name: [row for row in rows if row.get("device") == device] for name, rows in tables.items()}
        if any(mine.values()):
            _section(report, setting, device, {name: ordered(name, rows) for name, rows in mine.items()})
    if rows := tables.get("figure4"):
        _figure(report, rows)
    report.write()


def ordered(table: str, rows: Sequence[Row]) -> list[Row]:
    """As a single run has them: pieces come in any order."""
    if table in ("table1", "publishing", "automatic"):
        return sorted(rows, key=lambda row: (row["tets"], row.get("E") != "one"))
    if table == "table2":
        loads = [load.name for load in LOADS]
        return sorted(rows, key=lambda row: loads.index(row["load"]))
    return list(rows)


def _section(report: Report, setting: Setting, device: str, tables: Tables) -> None:
    shown = {
        "table1": _table1, "publishing": _publishing, "table2": _table2, "table5": _table5, "automatic": _automatic,
        "policies": _policies, "extrapolations": _extrapolations,
    }  # fmt: skip
    for name, show in shown.items():
        if rows := tables.get(name):
            show(report, setting, device.upper(), rows)
    judged = [row for name in KEYS for row in tables.get(name, []) if "repeats" in row]
    report.say(
        f"Solves that did not reach the tolerance: {sum(row['unconverged'] for row in judged)}. Iterations of all "
        f"rounds alike, step by step: {'yes' if all(row['repeats'] for row in judged) else 'NO'}."
    )


def _table1(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    report.say(
        f"## Table 1: sizes, {name}", f"Corotational, *{LOADS[1].name}*, async + warp, E of the beam of table 2."
    )
    report.table(rows, words.COLUMNS1)
    report.say(
        "*latency* is the paper's steps to factorize, rounded up; *own latency* what a factorization takes here in "
        "steps of this machine, one thread each."
    )


def _publishing(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    cores = "; ".join(sorted({row["cores"] for row in rows}))
    told = words.PUBLISHING.format(load=LOADS[1].name, cores=cores, stretch=STRETCH)
    report.say(f"## Asynchronous steps and what publishing costs, {name}", told)
    report.table(rows, words.COLUMNS_OF_PUBLISHING)


def _table2(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    calibrations = {row["model"]: f"{row['model']} {row['stiffness']:.5g} ({row['condition']:.1f})" for row in rows}
    report.say(
        f"## Table 2: loads, models and schemes, {name}",
        words.loads(),
        f"Stiffness and the condition number that it gives: {', '.join(calibrations.values())}. In each cell: "
        "iterations and ms per step, in brackets the paper's.",
    )
    report.table(words.shown2(rows))
    report.say(words.AIM2)


def _table5(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    bands = " : ".join(f"{share:g}" for _, share in BANDS)
    report.say(
        f"## Table 5: preconditioners on the heterogeneous beam, {name}",
        f"E in three bands {bands}, stiffest at the held end ({rows[0]['stiffness']:.5g} Pa there), condition number "
        f"{rows[0]['condition']:.0f}; *{LOADS[1].name}*. *invert*: what a step waits for.",
    )
    report.table(rows, words.COLUMNS5)
    report.say(words.AIM5)


def _automatic(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    report.say(f'## preconditioner = "auto" and what it chooses from, {name}', words.AUTOMATIC)
    report.table(rows, [key for key in rows[0] if key not in ("device", "unconverged", "repeats")])


def _policies(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    report.say(f"## Update policies, {name}", words.POLICIES.format(load=LOADS[2].name, latency=setting.latency))
    report.table(rows, words.COLUMNS_OF_POLICIES)


def _extrapolations(report: Report, setting: Setting, name: str, rows: list[Row]) -> None:
    told = words.EXTRAPOLATIONS.format(load=LOADS[2].name, steps=setting.steps)
    report.say(f"## Extrapolated states, {name}", told)
    report.table(rows, words.COLUMNS_OF_EXTRAPOLATIONS)


def _figure(report: Report, rows: list[Row]) -> None:
    latency = int(rows[0]["latency"])
    report.say("## Figure 4: schemes step by step", "Of deploy/scenes/beam.toml; more of it: figure4.md. On the CPU.")
    runs = {row["scheme"]: [_run(row["steps"])] for row in rows}
    report.figure(figure4.pictures(runs, latency), "paper.png", "Iterations and time of each step.")
    report.table(rows, ("scheme", "iterations, mean", "iterations, max", "step p50 [ms]", "step max [ms]"))
    report.say(figure4.order(rows, latency))


def _run(steps: dict[str, Any]) -> Run:
    """What the picture shows of one; from JSON too."""
    iterations, seconds = (np.array(steps[name], float) for name in ("iterations", "seconds"))
    unknown = np.full(len(iterations), np.nan)
    return Run(iterations, seconds, unknown, unknown, [], np.empty((0, 0, 3)))
