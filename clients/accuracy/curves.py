# SPDX-License-Identifier: MIT
"""What both diagrams show: the points of each axis, where failed ones are drawn, and the words of a point."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

from clients.accuracy.points import SCENE, Point, Points, set_words
from clients.accuracy.sources import MESH

TITLES = ("one setting at a time", "pairs, and how equations are solved")
SINGLE = (SCENE, "tolerance", "linearizations", "time step", "scheme", "position", "mesh", "model")
JOINED = {  # axes whose points are drawn as a line, in the order of this key
    "tolerance": "solver.tolerance",
    "linearizations": "integrator.linearizations",
    "time step": "dt",
    "position": "accuracy.position",
    "factor age": "solver.update",
    "drop tolerance": "solver.drop_tolerance",
}
ERROR = "largest distance of a node from the reference [m]"
TIME = "wall time a simulated second [s]"
EDGE = 2.0  # times the largest error (and time) of a point: where those without are drawn


@dataclass(frozen=True)
class Curve:
    """Points of one axis in one of the two diagrams (0: SINGLE axes, 1: the others)."""

    axis: str
    diagram: int
    points: list[Point]
    joined: bool
    label: str


def curves(found: Points) -> list[Curve]:
    """Returns the points by axis that are done; the scene's point is part of each line that it has a place in."""
    scene = [p for p in found.points if p.axis == SCENE and p.status == "done"]
    result = []
    for axis in dict.fromkeys(p.axis for p in found.points):
        points = [p for p in found.points if p.axis == axis and is_drawn(p)]
        if key := JOINED.get(axis):
            points += scene if key in found.own else []
            points.sort(key=lambda p: _number({**found.own, **p.settings}.get(key, "")))
        joined, label = axis in JOINED, axis
        if axis == MESH and scene and scene[0].mesh_error is not None and points:
            points.sort(key=_cells)
            points.insert(1, replace(scene[0], error=scene[0].mesh_error, against=points[0].against))
            joined, label = True, "mesh, from the extrapolated reference"
        if points:
            result.append(Curve(axis, int(axis not in SINGLE), points, joined, label))
    return result


def _cells(point: Point) -> int:
    """Returns a number that grows with the cells of the bars of a point of the axis mesh."""
    return math.prod(int(number) for value in point.settings.values() for number in re.findall(r"\d+", value))


def _number(value: str) -> float:
    """Returns the number in a setting: 0.01 of "0.01", 10 of "every-10"."""
    try:
        return float(value.rpartition("every-")[2])
    except ValueError:
        return 0.0


def is_drawn(point: Point) -> bool:
    """True if a point has its place in a diagram of logarithms."""
    return point.status == "done" and bool(point.error) and bool(point.seconds)


def at_the_edge(found: Points) -> list[tuple[Point, float, float]]:
    """Returns points that diverged, failed or were timed out, with the place at the edge where they are drawn."""
    right, top = edges(found)
    return [(p, right, p.seconds or top) for p in found.points if p.status != "done"]


def edges(found: Points) -> tuple[float, float]:
    """Returns error [m] and time [s] at which the others are drawn."""
    drawn = [p for p in found.points if is_drawn(p)]
    right = EDGE * max((p.error or 0.0 for p in drawn), default=found.size)
    return right, EDGE * max((p.seconds or 0.0 for p in drawn), default=1.0)


def words(point: Point) -> list[str]:
    """Describes a point, one line each: its settings, error, time, steps and what is special."""
    lines = [f"{point.axis}: {set_words(point.settings) or 'as the scene is'}"]
    if point.error is not None:
        lines.append(f"error {point.error:.3g} m (rms {point.rms or 0:.3g} m) from the {point.against}")
    if point.seconds is not None:
        times = point.step_ms or {}
        steps = ", ".join(f"{name} {value:.3g}" for name, value in times.items())
        lines.append(f"{point.seconds:.3g} s a simulated second ({len(point.rounds)} rounds); step {steps} ms")
        lines.append(f"{point.iterations or 0:.3g} iterations a step, {point.unconverged} solves not converged")
    if point.status != "done":
        lines.append(f"{point.status}: {point.reason}")
    return lines
