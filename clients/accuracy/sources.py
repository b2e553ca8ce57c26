# SPDX-License-Identifier: MIT
"""Errors by source: how far what is solved inexactly moves the bodies, one source after the other.

From the scene as it is, one approximation after the other is removed, and each removal moves the bodies by the error of
that source::

    scene -linear solve-> exact solves -linearization-> exact steps -time step-> reference -mesh-> mesh of size 0

The error of the scene is at most the sum of the first three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from clients.accuracy.errors import order_of_convergence
from clients.accuracy.points import SCENE, Point, Points, set_words
from clients.accuracy.trajectories import Trajectory, distance

LINEAR, LINEARIZATION, TIME, MESH, MODEL = "linear solve", "linearization", "time step", "mesh", "model"
SOURCES = (LINEAR, LINEARIZATION, TIME, MESH, MODEL)
ORDER = 2.0  # in the mesh, of positions, where it was not measured
LEAST_ORDER, MOST_ORDER = 0.5, 4.0  # that are believed of a measurement
HALF = 0.5  # of the scene's error: below, a setting counts as more exact
NEAR = 1.1  # times the least time: up to here, the most exact setting is taken
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
        ("time step", "scheme", "scheme and time step", "time step and tolerance", "time step and position"),
    ),
    MESH: ("refine the mesh (mesh.bar)", ("mesh",)),
}


def errors_by_source(
    scene: Trajectory | None, chain: Mapping[str, Trajectory | None]
) -> tuple[dict[str, float | None], float | None]:
    """Returns the errors [m] by source, None for what was not told, and that of all of `chain` which were not told.

    chain: by source that the scene has, in the order above, the run without it. From the first one that is missing on
    sources cannot be told apart; the last one is the reference, from which their common error is.
    """
    found: dict[str, float | None] = dict.fromkeys(SOURCES)
    last = scene
    for name, after in chain.items():
        if last is None or after is None:
            break
        found[name] = distance(last, after).error
        last = after
    else:
        return found, None
    goal = list(chain.values())[-1]
    return found, None if last is None or goal is None else distance(last, goal).error


def mesh_error(
    coarse: Trajectory | None, scene: Trajectory, fine: Trajectory | None
) -> tuple[float, float | None] | None:
    """Returns the error of the scene's mesh [m] by Richardson's extrapolation, and the order that it was taken with.

    coarse, fine: the same run on meshes of twice and of half the size of elements. With both the order is measured. It
    is None where their changes do not shrink: then the error is at least that to the finer mesh.
    """
    to_fine = None if fine is None else distance(scene, fine).error
    to_coarse = None if coarse is None else distance(coarse, scene).error
    order = ORDER
    if to_fine is not None and to_coarse is not None:
        measured = order_of_convergence(to_coarse, to_fine)
        if measured is None:
            return to_fine, None
        order = min(max(measured, LEAST_ORDER), MOST_ORDER)
    if to_fine is not None:
        return to_fine * 2**order / (2**order - 1), order
    return None if to_coarse is None else (to_coarse / (2**order - 1), order)


def is_rough(found: Points) -> bool:
    """True if the reference is too uncertain for the largest error that was told."""
    errors = [value for name, value in found.sources.items() if name != MODEL and value is not None]
    return bool(errors) and (found.reference.get("uncertainty") or 0.0) > HALF * max(errors)


def sentence(found: Points, missing: Sequence[str] = (), rest: float | None = None) -> str:
    """Says which source dominates and what to change first, with the measured point that does it at least cost.

    missing: sources that the scene has and that were not told; rest: common error of those among them that are not
    the mesh [m], None if it is not known
    """
    known = {name: value for name, value in found.sources.items() if value is not None}
    scene = next((p for p in found.points if p.axis == SCENE), None)
    if scene is not None and scene.status != "done":
        return f"The scene's own settings do not work ({scene.reason or scene.status}): change them first."
    errors = {name: value for name, value in known.items() if name != MODEL}
    together = " and ".join(name for name in missing if name != MESH)
    if rest is not None:
        errors[together] = rest
    if not errors or scene is None or scene.error is None:
        return "No error could be told by its source."
    first = max(errors, key=lambda name: errors[name])
    text = _dominant(found, first, errors, [name for name in missing if rest is None or name == MESH])
    if first != together:
        text += _better(found, scene, first)
    text += _cheaper(found, scene, first)
    if (model := known.get(MODEL, 0.0)) > errors[first]:
        text += f"; another law of the material moves it by {length(model)}, more than any of these: be sure of the law"
    if (uncertainty := found.reference.get("uncertainty") or 0.0) > HALF * errors[first]:
        text += f"; the reference itself is uncertain by {length(uncertainty)}, so all this is rough"
    if unconverged := found.reference.get("unconverged"):
        text += f"; {unconverged} solves of the reference did not reach their tolerance"
    return f"{text}."


def _dominant(found: Points, first: str, errors: dict[str, float], unknown: list[str]) -> str:
    """Says which error is the largest, and what the others are. unknown: sources that nothing is known of."""
    values = {name: said_length(found, name, value) for name, value in errors.items()}
    others = [f"{name} {values[name]}" for name in sorted(errors, key=_place) if name != first]
    others += [f"{name} not measured" for name in unknown]
    several = " and " in first
    what = f"errors of {first} together" if several else f"error of the {first}"
    verb = f"dominate{'' if several else 's'}" if not unknown else f"{'are' if several else 'is'} the largest measured,"
    return f"The {what} {verb} with {values[first]}" + (f" ({', '.join(others)})" if others else "")


def _place(name: str) -> int:
    """Returns the place of a source, or of the first of several ones, in SOURCES."""
    return SOURCES.index(name.split(" and ")[0])


def _better(found: Points, scene: Point, first: str) -> str:
    """Says what to change first, with a measured example."""
    change, axes = CHANGES[first]
    text, better = f": {change}", best(found.points, scene, axes, HALF * (scene.error or 0.0))
    if better is not None and better.error is not None and scene.error is not None:
        text += (
            f", for example {set_words(better.settings)}, which is {length(better.error)} off instead of "
            f"{length(scene.error)} and takes {_times(better, scene):.2g} times the time"
        )
    return text


def _cheaper(found: Points, scene: Point, first: str) -> str:
    """Says what takes less time than the scene and is as exact, of axes that are not those to change first."""
    _, changed = CHANGES.get(first, ("", ()))
    axes = tuple({p.axis for p in found.points} - {SCENE, MODEL, *changed})
    cheaper = best(found.points, scene, axes, EQUAL * (scene.error or 0.0))
    if cheaper is None or (times := _times(cheaper, scene)) >= WORTH:
        return ""
    return f"; {set_words(cheaper.settings)} is as exact as the scene and takes {times:.2g} times the time"


def best(points: list[Point], scene: Point, axes: tuple[str, ...], bound: float) -> Point | None:
    """Returns the point of these axes that takes the least time of those with an error of at most `bound` [m].

    Of several that take about that time it is the most exact one.
    """
    fit = [
        p
        for p in points
        if p.axis in axes and p.status == "done" and p.against == scene.against and p.seconds is not None
        if p.error is not None and p.error <= bound
    ]  # fmt: skip
    least = min((p.seconds or 0.0 for p in fit), default=0.0)
    return min((p for p in fit if (p.seconds or 0.0) <= NEAR * least), key=lambda p: p.error or 0.0, default=None)


def said_length(found: Points, source: str, error: float) -> str:
    """Returns the error of a source [m] in words."""
    return "at least " * (source in found.at_least) + length(error)


def length(metres: float) -> str:
    """Returns a length in words: 48 mm, 3.2 um."""
    units = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))
    unit, size = next((u for u in units if metres >= 0.9995 * u[1]), units[-1])
    value = metres / size
    return f"{value:.2g} {unit}" if value < 99.5 else f"{value:.0f} {unit}"


def _times(point: Point, scene: Point) -> float:
    return (point.seconds or 0.0) / (scene.seconds or 1.0)
