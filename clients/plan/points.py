# SPDX-License-Identifier: MIT
"""Reads points.json, what `sim-client accuracy` has measured."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clients.errors import BadInput
from protocol.printable import printable

VERSION = 1  # of points.json
REFERENCE = "reference"  # what errors are measured from
OTHER_BODIES = ("mesh", "model")  # axes that change what is simulated, beside how exactly that is done
KEY = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*")  # of an override


@dataclass(frozen=True)
class Point:
    """One measurement that came to its end.

    settings: values by key, as of `--set KEY=VALUE`
    error: largest distance of a node from the reference [m]
    seconds: wall time a simulated second, median over rounds
    slowest: that of the slowest round
    p50, p99, longest: time of a step [ms]
    iterations: mean of a step; NaN if not known
    unconverged: steps that did not reach their tolerance
    """

    axis: str
    settings: dict[str, str]
    error: float
    seconds: float
    slowest: float
    p50: float
    p99: float
    longest: float
    iterations: float
    unconverged: int


@dataclass(frozen=True)
class Points:
    """All measurements of a scene.

    digest: of the scene as resolved; duration: simulated [s]; uncertainty: of the reference [m], None if not known;
    lost: number of measurements left out, by reason
    """

    scene: str
    digest: str
    duration: float
    device: str
    machine: dict[str, str]
    uncertainty: float | None
    points: list[Point]
    lost: Counter[str]

    @property
    def floor(self) -> float:
        """The uncertainty of the reference [m]; 0 if it is not known."""
        return self.uncertainty or 0.0


def read(path: Path) -> Points:
    """Reads points.json. Raises BadInput, where it is another file or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["version"] != VERSION:
            raise BadInput(f"{path}: version {found['version']!r} of points; this sim-client reads {VERSION}")
        return _points(found)
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except (json.JSONDecodeError, RecursionError, AttributeError, KeyError, TypeError, ValueError) as error:
        what = printable(f"{type(error).__name__}: {error}")
        raise BadInput(f"{path}: no points of sim-client accuracy ({what})") from None


def _points(found: dict[str, Any]) -> Points:
    done, lost = [], Counter[str]()
    for point in found["points"]:
        if reason := _reason_to_leave_out(point):
            lost[reason] += 1
        else:
            done.append(_point(point))
    reference = found["reference"] or {}
    machine = {printable(str(k)): printable(str(v)) for k, v in found["machine"].items()}
    given = reference.get("uncertainty")
    uncertainty = None if given is None else _number(given)
    return Points(
        printable(str(found["scene"])), printable(str(found["digest"])), _number(found["duration"]),
        printable(str(found["device"])), machine, uncertainty, done, lost,
    )  # fmt: skip


def _reason_to_leave_out(point: dict[str, Any]) -> str:
    """Returns why a point is no choice; empty if it is one."""
    if point["status"] != "done":
        return printable(str(point["status"]))
    if any(point[name] is None for name in ("error", "seconds", "step_ms")):
        return "without an error or a time"
    if point["axis"] in OTHER_BODIES or point.get("against", REFERENCE) != REFERENCE:
        return "of another body or reference"
    return ""


def _point(point: dict[str, Any]) -> Point:
    settings = {str(key): str(value) for key, value in point["settings"].items()}
    for key, value in settings.items():
        if not KEY.fullmatch(key) or not value.isprintable():
            raise ValueError(f"setting {key}={value}")
    step, seconds = point["step_ms"], _number(point["seconds"])
    rounds = [_number(value) for value in point["rounds"]]
    return Point(
        printable(str(point["axis"])), settings, _number(point["error"]), seconds, max(rounds, default=seconds),
        _number(step["p50"]), _number(step["p99"]), _number(step["max"]),
        _number(point["iterations"], math.nan), int(point["unconverged"] or 0),
    )  # fmt: skip


def _number(value: Any, missing: float | None = None) -> float:
    """Returns a finite number >= 0; `missing` for None. Raises ValueError."""
    if value is None and missing is not None:
        return missing
    number = float(value)
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"{value!r} is no finite number of at least 0")
    return number
