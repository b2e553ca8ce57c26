# SPDX-License-Identifier: MIT
"""Pictures of work against precision, and of errors by source."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.bench.accuracy.axes import ERROR_OF, SCHEME
from tests.bench.accuracy.cases import RUBBER
from tests.bench.accuracy.peers import US
from tests.bench.harness.pieces import Row
from tests.bench.harness.report import plots

MARKERS = "os^Dv<>P*X"
COLOURS = {  # by style
    "-": [*(f"C{k}" for k in range(10)), "gold"],
    "--": ["k", "0.4", "m", "0.6", "navy", "darkgreen", "0.75"],
}
WORDS = {"error": "error", "step error": "error of the steps", "solve error": "error of the linear solves"}


def short(tables: dict[str, list[Row]], devices: Sequence[str]) -> Any:
    """The picture of the README: ours and others, a panel for each device."""
    plt = plots()
    figure, panels = plt.subplots(
        1, len(devices), figsize=(1 + 7 * len(devices), 5.2), squeeze=False, layout="constrained"
    )
    for panel, device in zip(panels[0], devices, strict=True):
        ours = [r for r in tables.get("points", []) if r["device"] == device and r["axis"] == SCHEME]
        ours = [r for r in ours if r["scene"] == RUBBER.name] or [r for r in ours if r["scene"] == ours[0]["scene"]]
        others = [r for r in tables.get("peers", []) if r["device"] == device and r["E MPa"] == 1 and r["who"] != US]
        named = [row | {"series": _who(row)} for row in others]
        curves(panel, ours, "error", style="-")
        curves(panel, named, "error", style="--")
        panel.set(title=device.upper(), ylabel="seconds of a simulated second")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=7)
    return figure


def _who(row: Row) -> str:
    """VBD is one curve for all its time steps."""
    return f"{row['who']} {row['series'].split(',')[0] if row['series'].startswith('VBD') else row['series']}"


def axes(rows: Sequence[Row]) -> Any:
    """A panel for each axis of a scene on a device."""
    plt = plots()
    names = list(dict.fromkeys(row["axis"] for row in rows))
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure, panels = plt.subplots(lines, columns, figsize=(1 + 4.6 * columns, 4.2 * lines), squeeze=False,
                                  layout="constrained")  # fmt: skip
    for panel in panels.flat[len(names) :]:
        panel.set_visible(False)
    for panel, name in zip(panels.flat, names, strict=False):
        curves(panel, [row for row in rows if row["axis"] == name], ERROR_OF.get(name, "error"))
        panel.set(title=name)
        panel.legend(fontsize=6)
    for panel in panels[:, 0]:
        panel.set_ylabel("seconds of a simulated second")
    return figure


def _series(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["series"] for row in rows))


def curves(panel: Any, rows: Sequence[Row], which: str, style: str = "-") -> None:
    """A curve for each series; what has no error stands as a cross at the right edge, at its time, or at the top."""
    for number, series in enumerate(_series(rows)):
        line = [row for row in rows if row["series"] == series]
        known = [row for row in line if row["status"] == "done" and row[which] and row["seconds"]]
        colours = COLOURS[style]
        look = {"color": colours[number % len(colours)], "marker": MARKERS[number % len(MARKERS)]}
        errors, seconds = [row[which] / row["length"] for row in known], [row["seconds"] for row in known]
        panel.plot(errors, seconds, style, ms=4, lw=1.2, label=series, **look)
        for row in line:
            if row["status"] != "done":
                edge = panel.get_yaxis_transform() if row["seconds"] else panel.transAxes
                panel.plot([0.98], [row["seconds"] or 0.98], "x", color=look["color"], ms=7, transform=edge)
    panel.set(xscale="log", yscale="log", xlabel=f"{WORDS[which]} / L")
    least, most = panel.get_xlim()
    panel.set_xlim(min(least, np.sqrt(least * most / 10)), max(most, np.sqrt(least * most * 10)))  # a decade at least
    panel.grid(True, which="both", alpha=0.3)


def sources(rows: Sequence[Row]) -> Any:
    """Bars side by side, a group for each scene."""
    plt = plots()
    scenes, names = (list(dict.fromkeys(row[key] for row in rows)) for key in ("scene", "source"))
    figure, panel = plt.subplots(figsize=(9, 3.6), layout="constrained")
    width = 0.8 / len(names)
    for k, name in enumerate(names):
        found = {row["scene"]: row["error"] / row["length"] for row in rows if row["source"] == name and row["error"]}
        places = np.array([j + (k - (len(names) - 1) / 2) * width for j, scene in enumerate(scenes) if scene in found])
        panel.bar(places, list(found.values()), width, label=name)
    panel.set(yscale="log", ylabel="error / L", xticks=range(len(scenes)), xticklabels=scenes)
    panel.grid(True, axis="y", alpha=0.3)
    panel.legend(fontsize=8)
    return figure
