# SPDX-License-Identifier: MIT
"""The picture accuracy.png: error and time of all points, and errors by source."""

from __future__ import annotations

import textwrap
from io import BytesIO
from typing import Any

from clients.accuracy.curves import ERROR, SINGLE, TIME, TITLES, at_the_edge, curves
from clients.accuracy.points import SCENE, Points
from clients.accuracy.sources import said_length
from clients.errors import ClientError
from protocol.process.extras import to_install

SYMBOLS = {"diverged": "x", "failed": "X", "timed out": "^"}
WIDTH = 150  # characters of a line of the title


def draw(found: Points) -> bytes:
    """Draws the points as PNG. Raises ClientError without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ClientError(f"matplotlib is not installed, of the extra view: {to_install('view')}") from None
    figure = Figure(figsize=(14, 9), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=[3, 1])
    first = figure.add_subplot(grid[0, 0])
    for number, plot in enumerate((first, figure.add_subplot(grid[0, 1], sharex=first, sharey=first))):
        _points(plot, found, number)
    _sources(figure.add_subplot(grid[1, :]), found)
    head = f"{found.scene} on {found.device}, {found.duration:g} s simulated\n"
    figure.suptitle(head + "\n".join(textwrap.wrap(found.sentence, WIDTH)), fontsize="medium")
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _points(plot: Any, found: Points, number: int) -> None:
    for curve in curves(found):
        if curve.axis == SCENE:
            scene = curve.points[0]
            plot.plot(scene.error, scene.seconds, "k*", markersize=14, zorder=5, label="the scene")
        elif curve.diagram == number:
            where = [p.error for p in curve.points], [p.seconds for p in curve.points]
            plot.plot(*where, "o-" if curve.joined else "o", markersize=5, linewidth=1, label=curve.label)
    labels: set[str] = set()
    for point, error, seconds in at_the_edge(found):
        if int(point.axis not in SINGLE) == number:
            label = None if point.status in labels else point.status
            plot.plot(error, seconds, SYMBOLS[point.status], color="tab:red", label=label)
            labels.add(point.status)
    if uncertainty := found.reference.get("uncertainty"):
        plot.axvline(uncertainty, color="0.5", linestyle=":", label="uncertainty of the reference")
    plot.set(title=TITLES[number], xlabel=ERROR, ylabel=TIME, xscale="log", yscale="log")
    plot.grid(alpha=0.3)
    if plot.get_legend_handles_labels()[1]:
        plot.legend(fontsize="small")


def _sources(plot: Any, found: Points) -> None:
    known = {name: value for name, value in found.sources.items() if value}
    plot.barh(list(known), list(known.values()), color="tab:blue", height=0.6)
    plot.invert_yaxis()
    plot.set(title="errors by source", xlabel="m")
    if known:
        plot.set_xscale("log")
        plot.set_xlim(min(known.values()) / 10, max(known.values()) * 10)
    for row, (name, value) in enumerate(known.items()):
        plot.text(value, row, f" {said_length(found, name, value)}", va="center", fontsize="small")
