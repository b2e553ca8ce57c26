# SPDX-License-Identifier: MIT
"""Errors by source: how far what is solved inexactly moves the bodies, one source after the other.

From the scene as it is, one approximation after the other is removed, and each removal moves the bodies by the error of
that source::

    scene -linear solve-> exact solves -linearization-> exact steps -time step-> reference -mesh-> mesh of size 0

The error of the scene is at most the sum of the first three.
"""

from __future__ import annotations

from clients.accuracy.errors import order_of_convergence
from clients.accuracy.points import SCENE, Point, Points, set_words
from clients.accuracy.trajectories import Trajectory, distance

LINEAR, LINEARIZATION, TIME, MESH, MODEL = "linear solve", "linearization", "time step", "mesh", "model"
SOURCES = (LINEAR, LINEARIZATION, TIME, MESH, MODEL)
ORDER = 2.0  # in the mesh, of positions, where it was not measured
MOST_ORDER = 4.0  # that is believed of a measurement
HALF = 0.5  # of the scene's error: below, a setting counts as more exact
EQUAL = 1.05  # times the scene's error: up to here, a setting counts as equally exact
WORTH = 0.8  # of the scene's time: below, a setting counts as cheaper

CHANGES = {  # what to change first, and the axes whose points show it
    LINEAR: ("solve the linear systems more exactly (solver.tolerance)", ("tolerance", "position")),
    LINEARIZATION: (
        "allow more linearizations a step (integrator.linearizations)",
        ("linearizations", "position", "linearizations and tolerance"),
    ),
    TIME: (
        "take a smaller time step or a scheme of second order (dt, integrator.scheme)",
        ("time step", "scheme", "scheme and time step", "time step and tolerance"),
    ),
    MESH: ("refine the mesh (mesh.bar)", ("mesh",)),
}


def errors_by_source(
    scene: Trajectory | None,
    exact_solves: Trajectory | None,
    exact_steps: Trajectory | None,
    reference: Trajectory | None,
) -> dict[str, float | None]:
    """Returns the errors [m] of linear solve, linearization and time step; None for what there is not.

    A trajectory that is None is skipped: the next source then begins where the last one ended.
    """
    found: dict[str, float | None] = dict.fromkeys(SOURCES)
    last = scene
    for name, after in ((LINEAR, exact_solves), (LINEARIZATION, exact_steps), (TIME, reference)):
        if last is None or after is None:
            continue
        found[name] = distance(last, after).error
        last = after
    return found


def mesh_error(coarse: Trajectory | None, scene: Trajectory, fine: Trajectory | None) -> tuple[float, float] | None:
    """Returns the error of the scene's mesh [m] by Richardson's extrapolation, and the order that it was taken with.

    coarse, fine: the same run on meshes of twice and of half the size of elements. With both the order is measured.
    """
    to_fine = None if fine is None else distance(scene, fine).error
    to_coarse = None if coarse is None else distance(coarse, scene).error
    order = ORDER
    if to_fine is not None and to_coarse is not None:
        measured = order_of_convergence(to_coarse, to_fine)
        order = ORDER if measured is None else min(max(measured, HALF), MOST_ORDER)
    if to_fine is not None:
        return to_fine * 2**order / (2**order - 1), order
    return None if to_coarse is None else (to_coarse / (2**order - 1), order)


def sentence(found: Points) -> str:
    """Says which source dominates and what to change first, with the measured point that does it at least cost."""
    known = {name: value for name, value in found.sources.items() if value is not None}
    scene = next((p for p in found.points if p.axis == SCENE), None)
    if scene is not None and scene.status != "done":
        return f"The scene's own settings do not work ({scene.reason or scene.status}): change them first."
    if not set(known) - {MODEL} or scene is None or scene.error is None:
        return "No error could be told by its source."
    errors = {name: value for name, value in known.items() if name != MODEL}
    first = max(errors, key=lambda name: errors[name])
    others = ", ".join(f"{name} {_length(errors[name])}" for name in SOURCES if name in errors and name != first)
    change, axes = CHANGES[first]
    text = (
        f"The error of the {first} dominates with {_length(errors[first])}{f' ({others})' if others else ''}: {change}"
    )
    better = best(found.points, scene, axes, HALF * scene.error)
    if better is not None and better.error is not None:
        text += (
            f", for example {set_words(better.settings)}, which is {_length(better.error)} off instead of "
            f"{_length(scene.error)} and takes {_times(better, scene):.2g} times the time"
        )
    every = tuple({p.axis for p in found.points} - {SCENE, "model"})
    cheaper = best(found.points, scene, every, EQUAL * scene.error)
    if cheaper is not None and cheaper is not better and (times := _times(cheaper, scene)) < WORTH:
        text += f"; {set_words(cheaper.settings)} is as exact as the scene and takes {times:.2g} times the time"
    if (model := known.get(MODEL, 0.0)) > errors[first]:
        text += (
            f"; another law of the material moves it by {_length(model)}, more than any of these: be sure of the law"
        )
    return f"{text}."


def best(points: list[Point], scene: Point, axes: tuple[str, ...], bound: float) -> Point | None:
    """Returns the point of these axes that takes the least time of those with an error of at most `bound` [m]."""
    fit = [
        p
        for p in points
        if p.axis in axes and p.status == "done" and p.against == scene.against and p.seconds is not None
        if p.error is not None and p.error <= bound
    ]  # fmt: skip
    return min(fit, key=lambda p: p.seconds or 0.0, default=None)


def _length(value: float) -> str:
    return f"{value:.2g} m"


def _times(point: Point, scene: Point) -> float:
    return (point.seconds or 0.0) / (scene.seconds or 1.0)
