# SPDX-License-Identifier: MIT
"""`sim-client accuracy`: measures a scene, writes the results into a folder and shows them."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clients.accuracy.page import render
from clients.accuracy.picture import draw
from clients.accuracy.points import Point, Points, short_words, to_csv, to_dict
from clients.accuracy.sources import said_length
from clients.accuracy.study import NO_TIME, Study
from clients.errors import BadInput, ClientError
from clients.log.atomic_file import atomic_file
from clients.progress import titled_progress_bar

if TYPE_CHECKING:
    from rich.console import Group

DEVICES = ("auto", "cpu", "gpu")
AXIS, SETTINGS = 14, 25  # characters of axis and settings of a point on a terminal, before they are folded
MOST_MINUTES = 10_000.0


def accuracy(scene: Path, out: Path | None, minutes: float, duration: float, device: str, as_json: bool) -> None:
    """Runs the command. Raises BadInput or ClientError."""
    if not 0 <= minutes <= MOST_MINUTES:
        raise BadInput(f"--minutes {minutes:g}: allowed is 0 (only draw what is there) to {MOST_MINUTES:g}")
    if not 0 < duration <= 3600:
        raise BadInput(f"--duration {duration:g}: allowed is above 0, up to 3600 s")
    if device not in DEVICES:
        raise BadInput(f"--device {device}: allowed are {', '.join(DEVICES)}")
    folder = Path(f"accuracy-{scene.stem}") if out is None else out
    try:
        with titled_progress_bar(60 * minutes) as progress:
            found = Study(scene, folder, duration if minutes else None, device, progress).run(minutes)
    except KeyboardInterrupt:
        if (folder / "points.json").exists():
            print(f"sim-client: points measured so far are in {folder}; the same command goes on", file=sys.stderr)
        raise
    missing = write(found, folder)
    for line in missing:
        print(f"sim-client: {line}", file=sys.stderr)
    if as_json:
        print(json.dumps(to_dict(found), allow_nan=False))
        return
    from rich.console import Console

    Console().print(report(found, folder))


def write(found: Points, folder: Path) -> list[str]:
    """Writes points.csv, accuracy.png and accuracy.html; returns why one of them is missing."""
    files: dict[str, Callable[[], str | bytes]] = {
        "points.csv": lambda: to_csv(found),
        "accuracy.png": lambda: draw(found),
        "accuracy.html": lambda: render(found),
    }
    missing = []
    for name, make in files.items():
        try:
            content = make()
        except ClientError as error:
            missing.append(f"{name} is not written: {error}")
            continue
        with atomic_file(folder / name) as part:
            part.write_bytes(content if isinstance(content, bytes) else content.encode())
    return missing


def report(found: Points, folder: Path) -> Group:
    """Shows points, errors by source and what was left out, for a terminal."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from clients.watch import COMPACT

    table = Table("axis", "settings", "error [m]", "s / s", "p99 [ms]", "iter.", **{**COMPACT, "padding": (0, 1, 0, 0)})
    table.columns[0].max_width, table.columns[1].overflow = AXIS, "fold"
    table.columns[1].min_width = min(SETTINGS, max((len(line) for p in found.points for line in _lines(p)), default=0))
    for p in found.points:
        numbers = (_cell(p.error, 2), _cell(p.seconds, 2), _cell((p.step_ms or {}).get("p99")), _cell(p.iterations))
        table.add_row(Text(p.axis), Text("\n".join(_lines(p))), *numbers)
    known = ", ".join(
        f"{name} {said_length(found, name, value)}" for name, value in found.sources.items() if value is not None
    )
    uncertainty = found.reference.get("uncertainty")
    lines = [
        f"{found.duration:g} s simulated on {found.device}; s / s: wall time of the steps of a simulated second; "
        f"the reference is uncertain by {_cell(uncertainty)} m",
        f"errors by source: {known or 'none known'}",
        found.sentence,
        *_left_out(found),
        f"written to {folder}",
    ]
    return Group(table, Text("\n".join(lines)))


def _lines(point: Point) -> list[str]:
    """Returns a line for each setting, and one for what went wrong."""
    lines = short_words(point.settings, "\n").splitlines()
    return lines if point.status == "done" else [*lines, f"({point.status}: {point.reason})"]


def _left_out(found: Points) -> list[str]:
    """Returns a line for what there was no time for, and one for each axis that was refused."""
    late = [left for left in found.left_out if left["reason"] == NO_TIME]
    lines = []
    if late:
        axes = ", ".join(dict.fromkeys(left["axis"] for left in late))
        lines.append(f"no time for {len(late)} points ({axes}): the same command goes on")
    for left in found.left_out:
        if left["reason"] != NO_TIME:
            words = short_words(left["settings"]) if left["settings"] else ""
            lines.append(f"left out: {left['axis']}{f' ({words})' if words else ''}: {left['reason']}")
    return lines


def _cell(value: Any, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"
