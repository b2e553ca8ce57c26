# SPDX-License-Identifier: MIT
"""Measured points and the file points.json that keeps them."""

from __future__ import annotations

import csv
import io
import json
import math
import shlex
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from clients.accuracy.checks import any_value, by_name, check, each, number, one_of, optional, text, whole, with_keys
from clients.errors import BadInput
from clients.log.atomic_file import atomic_file
from protocol.printable import printable

VERSION = 1
STATUSES = ("done", "diverged", "failed", "timed out")
SCENE = "scene"  # axis of the point with the scene's own settings

Settings = dict[str, str]  # KEY: VALUE as `sim-server --set KEY=VALUE` takes them


@dataclass
class Point:
    """Error and cost of a scene at some settings."""

    axis: str
    settings: Settings
    status: str  # of STATUSES
    reason: str = ""
    error: float | None = None  # largest distance of a node from the reference over all compared times [m]
    rms: float | None = None  # m, over all nodes and compared times
    errors: dict[str, float] = field(default_factory=dict)  # by object [m]
    seconds: float | None = None  # wall time of the steps of a simulated second, median over rounds
    rounds: list[float] = field(default_factory=list)
    step_ms: dict[str, float] | None = None  # p50, p99, max
    iterations: float | None = None  # mean a step, of all objects together
    unconverged: int = 0  # solves that did not reach their tolerance
    limit: float | None = None  # of one that timed out: wall time that its process had [s]
    against: str = "reference"  # what `error` is measured from; on the axis mesh its extrapolation
    mesh_error: float | None = None  # of the scene: its distance from what the axis mesh is measured from [m]


@dataclass
class Points:
    """The contents of points.json."""

    scene: str
    digest: str = ""  # of the resolved scene and its meshes
    duration: float = 0.0  # simulated [s]
    interval: float = 0.0  # between compared times [s]
    own: Settings = field(default_factory=dict)  # what the scene itself has for keys of the points
    device: str = ""
    machine: dict[str, str] = field(default_factory=dict)
    reference: dict[str, Any] = field(default_factory=lambda: {"settings": {}, "uncertainty": None})
    objects: dict[str, dict[str, float]] = field(default_factory=dict)  # size [m], nodes, elements
    points: list[Point] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)  # axis, settings, reason
    sources: dict[str, float | None] = field(default_factory=dict)  # m
    at_least: list[str] = field(default_factory=list)  # sources whose errors may be larger than said
    sentence: str = ""
    version: int = VERSION

    @property
    def size(self) -> float:
        """Largest extent of an object at rest [m]."""
        return max((o["size"] for o in self.objects.values()), default=math.nan)

    def point(self, settings: Settings) -> Point | None:
        """Returns the point with exactly these settings."""
        return next((p for p in self.points if p.settings == settings), None)

    def refusal(self, settings: Settings) -> str | None:
        """Returns why the server refused these settings; None if it did not, or was not asked."""
        return next((left["reason"] for left in self.left_out if left["settings"] == settings), None)


POINT = {  # checks of what a file has for the fields of a Point, and below for those of Points
    "axis": text, "settings": by_name(text), "status": one_of(*STATUSES), "reason": text, "error": optional(number),
    "rms": optional(number), "errors": by_name(optional(number)), "seconds": optional(number), "rounds": each(number),
    "step_ms": optional(by_name(number)), "iterations": optional(number), "unconverged": whole,
    "limit": optional(number), "against": text, "mesh_error": optional(number),
}  # fmt: skip
POINTS = {
    "points": each(by_name(any_value)), "scene": text, "digest": text, "duration": number, "interval": number,
    "own": by_name(text), "device": text, "machine": by_name(text),
    "reference": with_keys(settings=by_name(text), uncertainty=optional(number)),
    "objects": by_name(with_keys(size=number)),
    "left_out": each(with_keys(axis=text, settings=by_name(text), reason=text)),
    "sources": by_name(optional(number)), "at_least": each(text), "sentence": text,
}  # fmt: skip


def set_words(settings: Settings) -> str:
    """Returns the words for the command line of sim-server that repeat a point."""
    return shlex.join(word for key, value in settings.items() for word in ("--set", f"{key}={value}"))


def short_words(settings: Settings, between: str = " ") -> str:
    """Returns the settings with the last part of each key, or more where that is the same of several, to read only."""
    last = [key.split(".")[-1] for key in settings]
    short = {key: name if last.count(name) == 1 else key for key, name in zip(settings, last, strict=True)}
    return between.join(f"{short[key]}={value}" for key, value in settings.items()) or "as the scene is"


def to_dict(found: Points) -> dict[str, Any]:
    """Returns the points as values for JSON, the version first; what is not finite becomes None."""
    table = asdict(found)
    return {"version": table.pop("version"), **_finite(table)}


def save(found: Points, path: Path) -> None:
    """Writes points.json, whole or not at all."""
    text = json.dumps(to_dict(found), indent=1, allow_nan=False)
    with atomic_file(path) as part:
        part.write_text(text + "\n")


def load(path: Path) -> Points:
    """Reads points.json. Raises BadInput if it is none or of another version."""
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path}: cannot be read: {error}") from None
    if not isinstance(table, dict) or table.get("version") != VERSION:
        raise BadInput(f"{path}: no points of version {VERSION}")
    try:
        check(table, POINTS, "points")
        for count, point in enumerate(table["points"], 1):
            check(point, POINT, f"point {count}")
        table["points"] = [_of(Point, point) for point in table["points"]]
        return _of(Points, table)
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise BadInput(f"{path}: points that cannot be read: {printable(str(error))}") from None


def to_csv(found: Points) -> str:
    """Returns a table of all points, one a line; the columns error/OBJECT are the objects' errors [m]."""
    names = list(found.objects)
    head = ["axis", "settings", "status", "reason", "error_m", "rms_m", "seconds", "rounds"]
    head += ["p50_ms", "p99_ms", "max_ms", "iterations", "unconverged", "against"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*head, *(f"error/{name}" for name in names)])
    for p in found.points:
        times = p.step_ms or {}
        row = [p.axis, set_words(p.settings), p.status, p.reason, p.error, p.rms, p.seconds, len(p.rounds)]
        row += [times.get("p50"), times.get("p99"), times.get("max"), p.iterations, p.unconverged, p.against]
        writer.writerow([*row, *(p.errors.get(name) for name in names)])
    return out.getvalue()


def _of(kind: Any, table: dict[str, Any]) -> Any:
    """Makes a dataclass from a dictionary; keys that it does not know, of a later writer, are left aside."""
    known = {f.name for f in fields(kind)}
    return kind(**{key: value for key, value in table.items() if key in known})


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
