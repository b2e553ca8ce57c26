# SPDX-License-Identifier: MIT
"""Takes from what `sim-client accuracy` has measured the points that settings can be chosen from."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clients.accuracy.points import Point, Points, load
from clients.errors import BadInput
from protocol.printable import printable

REFERENCE = "reference"  # what errors are measured from
OTHER_BODIES = ("mesh", "model")  # axes that change what is simulated, beside how exactly that is done
KEY = re.compile(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*")  # of an override


@dataclass(frozen=True)
class Measurement:
    """A point with an error and a time.

    settings: values by key, as of `--set KEY=VALUE`
    error: largest distance of a node from the reference [m]
    seconds: wall time a simulated second, median over rounds
    slowest: that of the slowest round
    p50, p99, longest: time of a step [ms]
    iterations: mean of a step; NaN if not known
    unconverged: solves that did not reach their tolerance
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
class Measurements:
    """All points of a scene.

    found: as they were read; usable: those to choose from; lost: number of the others, by reason
    uncertainty: of the reference [m], None if not known
    """

    found: Points
    usable: list[Measurement]
    lost: Counter[str]
    uncertainty: float | None

    @property
    def floor(self) -> float:
        """The uncertainty of the reference [m]; 0 if it is not known."""
        return self.uncertainty or 0.0


def read(path: Path) -> Measurements:
    """Reads points.json. Raises BadInput, where it is another file or damaged."""
    found = load(path)
    try:
        usable, lost = [], Counter[str]()
        for point in found.points:
            if reason := _reason_to_leave_out(point):
                lost[reason] += 1
            else:
                usable.append(_measurement(point))
        for name in ("scene", "digest", "device"):
            setattr(found, name, printable(str(getattr(found, name))))
        found.machine = {printable(str(key)): printable(str(value)) for key, value in found.machine.items()}
        given = found.reference.get("uncertainty")
        return Measurements(found, usable, lost, None if given is None else _number(given))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        what = printable(f"{type(error).__name__}: {error}")
        raise BadInput(f"{path}: points that cannot be read: {what}") from None


def _reason_to_leave_out(point: Point) -> str:
    """Returns why a point is no choice; empty if it is one."""
    if point.status != "done":
        return printable(str(point.status))
    if point.axis in OTHER_BODIES or point.against != REFERENCE:
        return "of another body or reference"
    return "without an error or a time" if None in (point.error, point.seconds, point.step_ms) else ""


def _measurement(point: Point) -> Measurement:
    settings = {str(key): str(value) for key, value in point.settings.items()}
    for key, value in settings.items():
        if not KEY.fullmatch(key) or not value.isprintable():
            raise ValueError(f"setting {key}={value}")
    step: Mapping[str, Any] = point.step_ms or {}
    seconds = _number(point.seconds)
    slowest = max(map(_number, point.rounds or [seconds]))
    iterations = math.nan if point.iterations is None else _number(point.iterations)
    return Measurement(
        printable(str(point.axis)), settings, _number(point.error), seconds, slowest,
        _number(step["p50"]), _number(step["p99"]), _number(step["max"]), iterations, int(point.unconverged),
    )  # fmt: skip


def _number(value: Any) -> float:
    """Returns a finite number of at least 0. Raises ValueError or TypeError."""
    number = float(value)
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"{value!r} is no finite number of at least 0")
    return number
