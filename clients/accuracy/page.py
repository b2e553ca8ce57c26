# SPDX-License-Identifier: MIT
"""The page accuracy.html: the same diagrams, to zoom and point at, in one file that opens without a network."""

from __future__ import annotations

import html
import math
from typing import Any

from clients.accuracy.curves import ERROR, SINGLE, TIME, TITLES, at_the_edge, curves, words
from clients.accuracy.points import SCENE, Point, Points, set_words
from clients.errors import ClientError
from protocol.process.extras import to_install

SYMBOLS = {"diverged": "x", "failed": "x-open", "timed out": "triangle-up"}
STYLE = """\
body { font: 15px/1.4 sans-serif; margin: 1.5em; max-width: 1500px; color: #222; }
table { border-collapse: collapse; font-size: 13px; } td, th { border-bottom: 1px solid #ddd; padding: .2em .6em; }
td.n { text-align: right; } code { white-space: pre-wrap; } button { font-size: 12px; } .said { font-weight: bold; }
"""
SCRIPT = """\
async function copyWords(text, button) {
  try { await navigator.clipboard.writeText(text); }
  catch {  // pages from files may have no clipboard of that kind
    const area = document.createElement("textarea");
    area.value = text; document.body.append(area); area.select(); document.execCommand("copy"); area.remove();
  }
  if (button) { button.textContent = "copied"; setTimeout(() => { button.textContent = "copy"; }, 1000); }
}
for (const button of document.querySelectorAll("button[data-words]"))
  button.addEventListener("click", () => copyWords(button.dataset.words, button));
window.addEventListener("load", () => {
  for (const plot of document.querySelectorAll(".plotly-graph-div"))
    plot.on("plotly_click", event => {
      const found = event.points[0].customdata;
      if (found === undefined) return;
      copyWords(found, null);
      document.getElementById("clicked").textContent = "copied: " + (found || "(nothing: the scene as it is)");
    });
});
"""


def render(found: Points) -> str:
    """Returns the page. Raises ClientError without plotly."""
    try:
        from plotly import graph_objects as go
        from plotly.io import to_html
        from plotly.subplots import make_subplots
    except ImportError:
        raise ClientError(f"plotly is not installed, of the extra view: {to_install('view')}") from None
    figure = make_subplots(1, 2, subplot_titles=TITLES, shared_yaxes=True, shared_xaxes="all", horizontal_spacing=0.03)
    _points(figure, go, found)
    figure.update_layout(height=620, template="plotly_white", legend={"groupclick": "togglegroup"})
    figure.update_xaxes(type="log", title_text=ERROR, exponentformat="power")
    figure.update_yaxes(type="log", exponentformat="power")
    figure.update_yaxes(title_text=TIME, col=1)
    known = {name: value for name, value in found.sources.items() if value}
    bars = go.Figure(go.Bar(x=list(known.values()), y=list(known), orientation="h", hovertemplate="%{x:.3g} m"))
    bars.update_layout(height=280, template="plotly_white", title="errors by source", margin={"t": 50, "b": 40})
    bars.update_xaxes(type="log", title_text="m", exponentformat="power")
    bars.update_yaxes(autorange="reversed")
    options = {"full_html": False, "config": {"displaylogo": False}}
    plots = to_html(figure, include_plotlyjs=True, **options), to_html(bars, include_plotlyjs=False, **options)
    return _page(found, *plots)


def _points(figure: Any, go: Any, found: Points) -> None:
    for curve in curves(found):
        points, is_scene = curve.points, curve.axis == SCENE
        for column in (1, 2) if is_scene else (curve.diagram + 1,):
            trace = go.Scatter(
                x=[p.error for p in points], y=[p.seconds for p in points], name=curve.label, legendgroup=curve.axis,
                mode="lines+markers" if curve.joined else "markers", showlegend=column == 1 or not is_scene,
                marker={"symbol": "star", "size": 16, "color": "black"} if is_scene else {"size": 9}, **_said(points),
            )  # fmt: skip
            figure.add_trace(trace, row=1, col=column)
    shown: set[str] = set()
    for point, error, seconds in at_the_edge(found):
        trace = go.Scatter(
            x=[error], y=[seconds], mode="markers", name=point.status, legendgroup=point.status,
            showlegend=point.status not in shown,
            marker={"symbol": SYMBOLS[point.status], "size": 11, "color": "crimson"}, **_said([point]),
        )  # fmt: skip
        figure.add_trace(trace, row=1, col=1 + (point.axis not in SINGLE))
        shown.add(point.status)
    if uncertainty := found.reference.get("uncertainty"):
        label = {"text": "reference", "x": math.log10(uncertainty)}  # plotly takes the place of a text as a logarithm
        figure.add_vline(x=uncertainty, line_dash="dot", line_color="gray", annotation=label, row=1)  # type: ignore[arg-type]


def _said(points: list[Point]) -> dict[str, Any]:
    """Returns what a trace shows at its points, and the words that a click copies."""
    said = ["<br>".join(html.escape(line) for line in words(p)) for p in points]
    return {"hovertext": said, "hoverinfo": "text", "customdata": [set_words(p.settings) for p in points]}


def _page(found: Points, plots: str, bars: str) -> str:
    title = html.escape(f"{found.scene}: what accuracy costs")
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n<p class=said>{html.escape(found.sentence)}</p>\n"
        f"<p>{html.escape(_how(found))}</p>\n{plots}\n<p>A click on a point copies the words that repeat it. "
        f"<code id=clicked></code></p>\n{bars}\n{_table(found)}\n{_left_out(found)}\n<script>{SCRIPT}</script>\n"
        "</body></html>\n"
    )


def _how(found: Points) -> str:
    shown = (f"{value} cores" if key == "cores" else value for key, value in found.machine.items() if key != "system")
    machine = ", ".join(shown)
    reference = set_words(found.reference.get("settings", {}))
    uncertainty = found.reference.get("uncertainty") or 0.0
    return (
        f"{found.duration:g} s simulated on {found.device} ({machine}), compared every {found.interval:g} s with a run "
        f"at {reference}, which is uncertain by {uncertainty:.2g} m: so far it is from the next coarser one. Times are "
        "those of the steps, the median over rounds; what workers do beside is not counted, but for a factorization "
        "that a step waits for."
    )


def _table(found: Points) -> str:
    heads = ("axis", "settings", "", "error [m]", "rms [m]", "s a simulated s", "p50 [ms]", "p99 [ms]", "max [ms]")
    rows = "".join(_row(point) for point in found.points)
    cells = "".join(f"<th>{head}</th>" for head in (*heads, "iterations", "status"))
    return f"<h2>Points</h2>\n<table><tr>{cells}</tr>\n{rows}</table>"


def _row(point: Point) -> str:
    said = set_words(point.settings)
    times = point.step_ms or {}
    numbers = (point.error, point.rms, point.seconds, *(times.get(k) for k in ("p50", "p99", "max")), point.iterations)
    button = f'<button data-words="{html.escape(said)}">copy</button>'
    cells = "".join(f"<td class=n>{'' if value is None else f'{value:.3g}'}</td>" for value in numbers)
    status = html.escape(" ".join((point.status, point.reason)))
    return (
        f"<tr><td>{html.escape(point.axis)}</td><td><code>{html.escape(said) or 'as the scene is'}</code></td>"
        f"<td>{button}</td>{cells}<td>{status}</td></tr>\n"
    )


def _left_out(found: Points) -> str:
    if not found.left_out:
        return ""
    lines = (f"{left['axis']} {set_words(left['settings'])}: {left['reason']}" for left in found.left_out)
    return "<h2>Left out</h2>\n<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"
