# SPDX-License-Identifier: MIT
"""A layout for Foxglove and Lichtblick: bodies on the left, curves on the right."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from typing import Any

PLOTS = {  # title -> fields of ObjectStep
    "PCG iterations": ("iterations",),
    "true residual": ("residual",),
    "energy [J]": ("kinetic_energy", "elastic_energy", "gravity_energy", "work", "dissipated"),
    "step time [s]": ("step_seconds",),
}


def layout(names: Sequence[str], forces: Sequence[str] = (), readings: Sequence[str] = ()) -> str:
    """Returns the layout as JSON, which both programs import from a file, for objects of these names.

    forces, readings: topics of reactions and readings to plot; without any there is no such plot.
    """
    view = "3D!bodies"
    panels: dict[str, Any] = {view: _bodies(names)}
    for number, (title, fields) in enumerate(PLOTS.items()):
        shown = names[:1] if title.startswith("step time") else names
        panels[f"Plot!{number}"] = _plot(title, [(f"/step/{n}", field) for n in shown for field in fields])
    if forces:
        panels["Plot!forces"] = _plot("reactions [N]", [(topic, f"force.{axis}") for topic in forces for axis in "xyz"])
    if readings:
        panels["Plot!readings"] = _plot("readings [SI unit]", [(topic, "value") for topic in readings])
    right = _stacked([name for name in panels if name != view])
    found = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": view, "second": right, "splitPercentage": 60},
    }
    return json.dumps(found, indent=2) + "\n"


def _bodies(names: Iterable[str]) -> dict[str, Any]:
    clouds = {
        f"/nodes/{name}": {"visible": False, "colorField": "von_mises", "colorMode": "colormap", "pointSize": 6}
        for name in names
    }
    return {
        "followTf": "world",
        "followMode": "follow-none",
        "scene": {"enableStats": False},
        "topics": {"/bodies": {"visible": True}, "/obstacles": {"visible": True}, **clouds},
    }


def _plot(title: str, curves: Iterable[tuple[str, str]]) -> dict[str, Any]:
    paths = [
        {
            "value": f"{_quoted(topic)}.{field}",
            "label": f"{topic.split('/', 2)[2]} {field}",
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for topic, field in curves
    ]
    return {
        "title": title, "foxglovePanelTitle": title, "paths": paths, "showLegend": True, "legendDisplay": "floating",
        "xAxisVal": "timestamp", "isSynced": True, "showXAxisLabels": True, "showYAxisLabels": True,
    }  # fmt: skip


def _quoted(topic: str) -> str:
    """Returns a topic as paths have it: in quotes where it holds more than letters and slashes."""
    return topic if re.fullmatch(r"[\w/]+", topic) else f'"{topic}"'


def _stacked(panels: Sequence[str]) -> Any:
    if len(panels) == 1:
        return panels[0]
    share = 100 / len(panels)
    return {"direction": "column", "first": panels[0], "second": _stacked(panels[1:]), "splitPercentage": share}
