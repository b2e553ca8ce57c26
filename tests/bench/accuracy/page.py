# SPDX-License-Identifier: MIT
"""The page of bench accuracy: a section for each part that there are rows of."""

import csv
from collections.abc import Callable, Iterable
from pathlib import Path

from clients.accuracy.points import set_words
from clients.accuracy.sources import length
from tests.bench.accuracy import peers, picture, words
from tests.bench.accuracy.axes import ERROR_OF, EXPLICIT_NAME, SCHEME, STEPS, order_of
from tests.bench.accuracy.cases import CASES
from tests.bench.accuracy.short import Tables, position_sentence, sentences
from tests.bench.accuracy.sources import orders, sentence
from tests.bench.harness.pieces import Row
from tests.bench.harness.report import Report

SOURCES = ("linear solve", "linearization", "time step", "mesh", "model")
SCENES = [case.name for case in CASES]


def write(report: Report, tables: Tables) -> None:
    """Page, pictures, CSV and JSON. tables: rows by the name of their table."""
    report.data |= {name: rows for name, rows in tables.items() if rows}
    devices = list(dict.fromkeys(row["device"] for row in tables.get("points", [])))
    said = [(device, line) for device in devices[:1] for line in sentences(tables, device)]
    if said:
        report.say("## In short")
        report.table([{"to read from it": line} for _, line in said])
    if devices:
        report.figure(picture.short(tables, devices), "accuracy.png", " ".join(words.SHORT.split()))
    report.say("## How", words.SETUP)
    shown: dict[str, Callable[[Report, list[Row]], None]] = {
        "sources": _sources, "points": _points, "meshes": _meshes, "effectivity": _effectivity, "peers": _peers,
    }  # fmt: skip
    for name, show in shown.items():
        if rows := tables.get(name, []):
            show(report, rows)
    _write_csv(report.folder / "accuracy.csv", tables)
    report.write()


def _by(rows: Iterable[Row], *names: str) -> dict[tuple[str, ...], list[Row]]:
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in names), []).append(row)
    return found


def _over(row: Row, name: str = "error") -> str | None:
    """An error over L."""
    return None if row[name] is None else f"{row[name] / row['length']:.1e}"


def _said(metres: float | None) -> str | None:
    return None if metres is None else length(metres)


# --- errors by source -------------------------------------------------------------------------------------------------


def _sources(report: Report, rows: list[Row]) -> None:
    report.say("## Errors by source", words.SOURCES)
    lines, said = [], []
    for (scene,), several in _by(rows, "scene").items():
        found = {row["source"]: row["error"] for row in several}
        first = several[0]
        lines.append({"scene": scene, **{name: _said(found.get(name)) for name in SOURCES},
                      "all together": _said(first["all together"]), "uncertain by": _said(first["apart"])})  # fmt: skip
        said.append(f"* {sentence(scene, found)}")
    report.table(lines)
    report.say("\n".join(said))
    report.figure(picture.sources(rows), "accuracy_sources.png", "Errors by source, over L.")
    remembered = [{"what": f"{row['scene']}, {row['source']}", "error / L": row["error"] / row["length"]}
                  for row in rows if row["error"] is not None]  # fmt: skip
    report.remember(remembered, ("what",), ("error / L",))


# --- points -----------------------------------------------------------------------------------------------------------


def _points(report: Report, rows: list[Row]) -> None:
    for (device,), of_device in _by(rows, "device").items():
        where = "" if device == "cpu" else f", {device.upper()}"
        if steps := [row for row in of_device if row["axis"] == STEPS]:
            _steps(report, steps, where)
        if schemes := [row for row in of_device if row["axis"] == SCHEME]:
            report.say(f"## Orders in time{where}", words.ORDERS)
            lines = [order_line(several) for several in _by(schemes, "scene", "series").values()]
            report.table([line for line in lines if line])
        report.say(f"## Work and precision{where}", words.AXES)
        for (scene,), several in _by(of_device, "scene").items():
            _axes(report, scene, several, device)
        if bad := [row for row in of_device if row["status"] != "done"]:
            report.say(f"### Not done{where}")
            report.table(bad, ("scene", "axis", "series", "value", "status", "reason"))


def _steps(report: Report, rows: list[Row], where: str) -> None:
    report.say(f"## Tolerance and linearizations{where}", words.STEPS)
    for (scene,), several in _by(rows, "scene").items():
        report.say(f"### {scene}: steps{where}")
        report.table([_step_line(row) for row in several])
        if said := position_sentence(several):
            report.say("\n".join(f"* {line}" for line in said))
    usual = [row for row in rows if (row["series"], row["value"]) == ("1", "1e-6")]
    kept = [
        {"scene": row["scene"] + where, "p50 ms": row["step_ms"]["p50"], "iterations": row["iterations"]}
        for row in usual
    ]
    report.remember(kept, ("scene",), ("p50 ms", "iterations"))


def _axes(report: Report, scene: str, rows: list[Row], device: str) -> None:
    where, end = ("", "") if device == "cpu" else (f", {device.upper()}", f"_{device}")
    file = f"accuracy_{scene.replace(' ', '_')}{end}.png"
    report.figure(picture.axes(rows), file, f"{scene}{where}: work against precision.")
    report.say(f"### {scene}: points{where}", words.CELLS)
    for (axis,), several in _by(rows, "axis").items():
        if axis != STEPS:
            report.say(f"{axis}:")
            report.table(_lines(several))


def _step_line(row: Row) -> Row:
    times = row["step_ms"]
    return {
        "linearizations": row["series"], "tolerance": row["value"],
        "error of the steps / L": _over(row, "step error") or row["status"], "error / L": _over(row),
        "iterations a step": row["iterations"],
        "linearizations a step": row["linearizations"], "p50 ms": times["p50"], "p99 ms": times["p99"],
        "max ms": times["max"], "unconverged": row["unconverged"],
    }  # fmt: skip


def order_line(rows: list[Row]) -> Row | None:
    """Of a scheme on a scene: exponents between neighbouring time steps; None where there are none.

    An explicit scheme has none: its substeps are as long as is stable, whatever the time step is.
    """
    if rows[0]["series"].startswith(EXPLICIT_NAME):
        return None
    sizes = [float(row["value"].split()[0]) for row in rows]
    errors = [row["rms"] if row["status"] == "done" else None for row in rows]
    found = orders(sizes, errors, rows[0]["apart"])
    if not found:
        return None
    first = rows[0]
    line = {"scene": first["scene"], "scheme": first["series"], "should be": order_of(first["series"])}
    return line | {"p at the smallest": found[-1], "p": ", ".join(f"{p:.2g}" for p in found)}


def _lines(rows: list[Row]) -> list[Row]:
    """A line for each series, a column for each value."""
    values = list(dict.fromkeys(row["value"] for row in rows))
    found = []
    for (series,), several in _by(rows, "series").items():
        by_value = {row["value"]: row for row in several}
        cells: Row = {value: _cell(by_value.get(value)) for value in values}
        found.append({"": series} | cells)
    return found


def _cell(row: Row | None) -> str | None:
    if row is None:
        return None
    metres = row[ERROR_OF.get(row["axis"], "error")]
    if metres is None or row["seconds"] is None:
        return str(row["status"])
    return f"{1e3 * metres:.2g}, {row['seconds']:.3g}"


# --- the other parts --------------------------------------------------------------------------------------------------


def _meshes(report: Report, rows: list[Row]) -> None:
    report.say("## Order in the mesh", words.MESHES)
    lines = []
    for several in _by(rows, "scene").values():
        apart = [row["rms to the next finer"] for row in several]
        found = [None, *orders([row["h m"] for row in several], apart)]
        for row, p in zip(several, found, strict=False):
            lines.append({"scene": row["scene"], "cells across": row["cells across"], "tets": row["tets"],
                          "rms to the next finer / L": _over(row, "rms to the next finer"),
                          "largest / L": _over(row, "largest"), "p": p, "should be": 2})  # fmt: skip
    report.table(lines)


def _effectivity(report: Report, rows: list[Row]) -> None:
    report.say("## How good the estimates are", words.EFFECTIVITY)
    report.table([
        {"scene": row["scene"], "device": row["device"], "settings": row["way"], "estimate": row["estimate"],
         "steps": row["steps"], "median": row["median"], "least": row["least"], "most": row["most"],
         "true error, median": _said(row["true"]), "most of it": _said(row["true, most"])}
        for row in rows
    ])  # fmt: skip
    known = [{"what": f"{row['scene']}, {row['way']}, {row['estimate']}", "effectivity": row["median"]}
             for row in rows if row["median"] is not None]  # fmt: skip
    report.remember(known, ("what",), ("effectivity",))


def _peers(report: Report, rows: list[Row]) -> None:
    report.say("## Beside others", words.PEERS)
    there = {row["who"] for row in rows}
    left_out = [name for name in (*peers.MODULES, *peers.WITHOUT_SCRIPT) if name not in there]
    if left_out:
        report.say(f"Not measured here: {', '.join(left_out)}.")
    for (young, device), several in _by(rows, "E MPa", "device").items():
        report.say(f"### E = {young:g} MPa, {device.upper()}")
        report.table([
            {"by": row["who"], "method": row["series"], "settings": row["value"],
             "error / L": _over(row) or row["status"], "reference / L": _over(row, "apart"),
             "error of the steps / L": _over(row, "step error"),
             "s a simulated s": row["seconds"], "version": row["version"] or None}
            for row in several
        ])  # fmt: skip


def _write_csv(path: Path, tables: Tables) -> None:
    """All points, one a line, with the settings that repeat it."""
    names = ("device", "scene", "who", "axis", "series", "value", "status", "reason", "error", "rms", "step error",
             "solve error", "seconds", "iterations", "unconverged")  # fmt: skip
    with path.open("w", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*names, "p50 ms", "p99 ms", "max ms", "settings"])
        for row in (*tables.get("points", []), *tables.get("peers", [])):
            times, said = row.get("step_ms", {}), set_words(row["settings"])
            writer.writerow([row.get(name) for name in names] + [times.get(q) for q in ("p50", "p99", "max")] + [said])
