# SPDX-License-Identifier: MIT
"""The image of a load test: iterations and factor age of each body, step times, outcomes of the commands."""

from __future__ import annotations

from io import BytesIO
from typing import Any

from clients.errors import ClientError
from protocol.process.extras import to_install

BINS = 60


def draw(found: dict[str, Any]) -> bytes:
    """Draws a report (report.py) as PNG."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ClientError(f"matplotlib is not installed, of the extra view: {to_install('view')}") from None
    figure = Figure(figsize=(12.8, 8), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(2, 2)
    _bodies(plots[0, 0], found, "iterations", "PCG iterations")
    _bodies(plots[0, 1], found, "factor_age", "factor age [steps]")
    _steps(plots[1, 0], found)
    _commands(plots[1, 1], found)
    steps, clients = found["steps"], len(found["clients"]["each"])
    figure.suptitle(
        f"{len(found['objects'])} bodies, {found['workers']['count']} workers, {clients} clients: "
        f"{steps['count']} steps, {steps['late']} late, {found['workers']['factors_per_second']:.1f} factors/s"
    )
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _bodies(plot: Any, found: dict[str, Any], what: str, title: str) -> None:
    """Plots mean and 99th percentile over the size of the body."""
    bodies = [body for body in found["objects"] if body[f"{what}_mean"] is not None]
    tets = [body["tets"] for body in bodies]
    plot.vlines(tets, [b[f"{what}_mean"] for b in bodies], [b[f"{what}_p99"] for b in bodies], color="0.8")
    plot.plot(tets, [b[f"{what}_mean"] for b in bodies], "o", label="mean")
    plot.plot(tets, [b[f"{what}_p99"] for b in bodies], "_", label="p99")
    plot.set(title=title, xlabel="tetrahedra", xscale="log")
    plot.set_ylim(bottom=0)
    if bodies:
        plot.legend(fontsize="small")


def _steps(plot: Any, found: dict[str, Any]) -> None:
    milliseconds, dt = found["steps"]["ms"], 1e3 * found["dt"]
    if milliseconds:
        plot.hist(milliseconds, bins=BINS)
        plot.set_yscale("log")
    plot.axvline(dt, color="0.3", linestyle=":", label=f"dt = {dt:g} ms")
    plot.set(title="whole steps", xlabel="ms", ylabel="steps")
    plot.legend(fontsize="small")


def _commands(plot: Any, found: dict[str, Any]) -> None:
    names = ("sent", "done", "refused", "unanswered", "skipped")
    plot.bar(names, [found["clients"]["commands"][name] for name in names])
    plot.set(title="commands of all clients")
