# SPDX-License-Identifier: MIT
"""Names combinations of settings that were measured apart only, and may be worth a measurement together."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from clients.plan.front import Choice, Wish
from clients.plan.measurements import Measurement, Measurements

OF_SOLVES = ("solver.", "accuracy.", "integrator.linearizations")  # keys that change nothing where none are solved
WORTH = 0.9  # of the error or cost of the scene's own settings: below, others alone are of use


def untried(points: Measurements, wish: Wish, choice: Choice) -> list[dict[str, str]]:
    """Returns combinations of two measured settings that may be better than `choice`, the most promising first.

    Factors by which each alone changes time and error of the scene's own settings are multiplied. That is good for an
    order of measurements alone: nothing of it is told.
    """
    own = next((p for p in points.usable if not p.settings), None)
    if own is None or not own.error:
        return []
    tried = [p.settings for p in points.found.points] + [left["settings"] for left in points.found.left_out]
    found = []
    useful = [p for p in points.usable if p.error < WORTH * own.error or wish.cost(p) < WORTH * wish.cost(own)]
    for a, b in combinations(useful, 2):
        settings = {**a.settings, **b.settings}
        if settings in tried or _overlap(a.settings, b.settings) or _is_idle(a.settings, b.settings):
            continue
        guess = _product(own, a, b, settings)
        better = wish.cost(guess) < wish.cost(choice.point) if wish.cheapest else guess.error < choice.point.error
        if wish.fits(guess, points.floor) and (better or not choice.reached):
            found.append(guess)
    found.sort(key=wish.cost if wish.cheapest else lambda p: p.error)
    return [guess.settings for guess in found]


def _overlap(a: dict[str, str], b: dict[str, str]) -> bool:
    """True if a key of one is one of the other, or the table that it is in."""
    return any(f"{x}.".startswith(f"{y}.") or f"{y}.".startswith(f"{x}.") for x in a for y in b)


def _is_idle(a: dict[str, str], b: dict[str, str]) -> bool:
    """True if one of both sets a scheme that solves no equations, and the other one only how they are solved."""
    return any(
        any(key.startswith("integrator") and "central_difference" in value for key, value in x.items())
        and all(key.startswith(OF_SOLVES) for key in y)
        for x, y in ((a, b), (b, a))
    )


def _product(own: Measurement, a: Measurement, b: Measurement, settings: dict[str, str]) -> Measurement:
    error, seconds, p99 = (
        getattr(a, name) * getattr(b, name) / max(getattr(own, name), 1e-30) for name in ("error", "seconds", "p99")
    )
    return replace(own, settings=settings, error=error, seconds=seconds, p99=p99)
