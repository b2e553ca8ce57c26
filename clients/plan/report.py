# SPDX-License-Identifier: MIT
"""Puts a choice into words: what was measured, with how much margin, and what lies next to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from clients.plan.front import Budget, Choice, Wish, bound
from clients.plan.measurements import Measurement, Measurements

if TYPE_CHECKING:
    from rich.table import Table


def settings(point: Measurement) -> str:
    """Returns settings as they are written on a command line."""
    return " ".join(f"{key}={value}" for key, value in point.settings.items()) or "the scene as it is"


def figures(point: Measurement, points: Measurements) -> str:
    """Returns what was measured, in words."""
    iterations = "" if math.isnan(point.iterations) else f", {point.iterations:.3g} iterations a step"
    return (
        f"error {_error(point, points)}, step p50 {point.p50:.3g}, p99 {point.p99:.3g}, max {point.longest:.3g} ms, "
        f"{point.seconds:.3g} s a simulated second{iterations}"
    )


def answer(points: Measurements, wish: Wish, choice: Choice) -> str:
    """Returns the first sentence."""
    point = choice.point
    if choice.reached:
        best = "the cheapest" if wish.cheapest else "the most exact"
        return f"{wish}: {best} of {len(points.usable)} measured settings: {settings(point)}"
    what = "the most exact ones" if wish.cheapest else "the nearest ones"
    return f"{wish}: none of {len(points.usable)} measured settings; {what}: {settings(point)}"


def notes(points: Measurements, wish: Wish, choice: Choice, untried: Sequence[dict[str, str]]) -> list[str]:
    """Returns what else there is to say of a choice, a sentence each."""
    point = choice.point
    told = [_margin(points, wish, choice), *_reference(points, wish, choice)]
    if point.slowest > 1 >= point.seconds:
        told.append(f"one round took {point.slowest:.3g} s a simulated second: real time is not certain")
    if point.unconverged:
        told.append(f"{point.unconverged} steps did not reach their tolerance")
    if points.lost:
        lost = ", ".join(f"{count} {status}" for status, count in points.lost.most_common())
        told.append(f"measurements left out: {lost}")
    if untried:
        together = " ".join(f"{key}={value}" for key, value in untried[0].items())
        told.append(f"measured apart but not together, may be better: {together} (--measure MINUTES tries it)")
    return told


def _margin(points: Measurements, wish: Wish, choice: Choice) -> str:
    point = choice.point
    if isinstance(wish, Budget):
        step = f"p99 {point.p99:.3g} of {wish.step:g} ms ({_share(point.p99 / wish.step)})"
        return f"{step}, {point.seconds:.3g} of 1 s a simulated second ({_share(point.seconds)})"
    pace = "keeps pace with the clock" if point.seconds < 1 else "is slower than the clock"
    error = bound(point, points.floor)
    return (
        f"error at most {error:.2g} of {wish.position:g} m ({_share(error / wish.position)}); "
        f"{point.seconds:.3g} s a simulated second, which {pace}"
    )


def _share(used: float) -> str:
    return f"{100 * (1 - used):.0f} % left" if used <= 1 else f"{used:.3g} times too much"


def _reference(points: Measurements, wish: Wish, choice: Choice) -> list[str]:
    """Returns what the uncertainty of the reference leaves open."""
    if points.uncertainty is None:
        return ["how exact the reference is was not measured; the errors are distances from it"]
    u = points.uncertainty
    if not isinstance(wish, Budget) and not choice.reached and choice.point.error <= wish.position:
        return [
            f"its distance from the reference is {choice.point.error:.2g} m, but the reference itself is uncertain by "
            f"{u:.2g} m: a finer one could confirm it"
        ]
    if choice.point.error <= u:
        return [f"the reference is uncertain by {u:.2g} m: settings with smaller errors are not told apart"]
    return []


def _error(point: Measurement, points: Measurements) -> str:
    if points.uncertainty is None:
        return f"{point.error:.2g} m"
    if point.error <= points.uncertainty:
        return f"at most {bound(point, points.floor):.2g} m"
    return f"{point.error:.2g} m (+- {points.uncertainty:.2g} m)"


def comments(points: Measurements, wish: Wish, choice: Choice, use: str, mark: str) -> list[str]:
    """Returns the comments of an overlay. use: the command that takes it; mark: begins the first one"""
    machine = ", ".join(f"{key} {value}" for key, value in points.found.machine.items())
    near = (("cheaper", choice.cheaper), ("more exact", choice.more_exact))
    return [
        f"{mark} for {points.found.scene}: {wish}.",
        f"Use: {use}",
        "",
        f"Measured: {figures(choice.point, points)};",
        f"  axis {choice.point.axis!r}, {points.found.duration:g} s simulated on {points.found.device} ({machine}).",
        *(f"Next, {word}: {settings(p)}: {figures(p, points)}." for word, p in near if p is not None),
        f"Digest of the scene: {points.found.digest}",
    ]  # fmt: skip


def as_json(points: Measurements, wish: Wish, choice: Choice, untried: Sequence[dict[str, str]]) -> dict[str, Any]:
    """Returns the answer for programs."""

    def shown(point: Measurement | None) -> dict[str, Any] | None:
        if point is None:
            return None
        found = {**asdict(point), "bound": bound(point, points.floor), "fits": wish.fits(point, points.floor)}
        return {key: None if isinstance(v, float) and math.isnan(v) else v for key, v in found.items()}

    found = points.found
    return {
        "scene": found.scene, "digest": found.digest, "device": found.device, "machine": found.machine,
        "wish": {"budget_ms": wish.step} if isinstance(wish, Budget) else {"position": wish.position},
        "reached": choice.reached, "chosen": shown(choice.point), "cheaper": shown(choice.cheaper),
        "more_exact": shown(choice.more_exact), "uncertainty": points.uncertainty,
        "notes": notes(points, wish, choice, untried), "untried": list(untried),
    }  # fmt: skip


def table(points: Measurements, choice: Choice) -> Table:
    """Returns a table of the choice and its neighbours on the front."""
    from rich.table import Table

    from clients.watch import COMPACT

    found = Table("", "settings", "error, m", "p99, ms", "s per s", "iter.", **COMPACT)
    found.columns[1].overflow = "fold"
    chosen = "chosen" if choice.reached else "nearest"
    for word, p in (("cheaper", choice.cheaper), (chosen, choice.point), ("more exact", choice.more_exact)):
        if p is not None:
            iterations = "-" if math.isnan(p.iterations) else f"{p.iterations:.3g}"
            found.add_row(
                word, settings(p).replace(" ", "\n") if p.settings else settings(p), f"{p.error:.2g}", f"{p.p99:.3g}",
                f"{p.seconds:.3g}", iterations,
            )  # fmt: skip
    return found
