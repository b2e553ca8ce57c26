# SPDX-License-Identifier: MIT
"""Chooses among measured points by what none of the others improves in cost and error at once (Pareto front)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

from clients.errors import BadInput
from clients.plan.measurements import Measurement


@dataclass(frozen=True)
class Budget:
    """The most exact settings with steps (p99) below a time, in real time.

    step: [ms]
    """

    step: float
    cheapest: ClassVar[bool] = False

    def cost(self, point: Measurement) -> float:
        """Returns the part of the time that is used: of that of a step, or of a second that is simulated."""
        return max(point.p99 / self.step, point.seconds)

    def fits(self, point: Measurement, uncertainty: float) -> bool:
        """Returns True if the point is as wished."""
        return self.cost(point) <= 1

    def __str__(self) -> str:
        return f"steps within {self.step:g} ms, in real time"


@dataclass(frozen=True)
class Exactness:
    """The cheapest settings with an error of at most a length.

    position: [m]
    """

    position: float
    cheapest: ClassVar[bool] = True

    def cost(self, point: Measurement) -> float:
        """Returns the wall time a simulated second."""
        return point.seconds

    def fits(self, point: Measurement, uncertainty: float) -> bool:
        """Returns True if the point is as wished, also where the reference is off as far as it may be [m]."""
        return bound(point, uncertainty) <= self.position

    def __str__(self) -> str:
        return f"positions within {self.position:g} m"


Wish = Budget | Exactness


def wish_for(budget_ms: float | None, position: float | None) -> Wish:
    """Returns the wish of a command line. Raises BadInput."""
    for name, value in (("--budget-ms", budget_ms), ("--position", position)):
        if value is not None and not (0 < value < math.inf):
            raise BadInput(f"{name} {value:g}: allowed are numbers above 0")
    if budget_ms is not None and position is None:
        return Budget(budget_ms)
    if position is not None and budget_ms is None:
        return Exactness(position)
    raise BadInput("plan: give one of --budget-ms MS and --position M")


@dataclass(frozen=True)
class Choice:
    """A point of the front, and the next ones there.

    point: the best one as wished; if none is as wished, the nearest to it
    """

    point: Measurement
    reached: bool
    cheaper: Measurement | None
    more_exact: Measurement | None


def bound(point: Measurement, uncertainty: float) -> float:
    """Returns what the error is at most: errors below the uncertainty of the reference [m] say no more than that."""
    return max(point.error, uncertainty) + uncertainty


def front(points: Sequence[Measurement], cost: Callable[[Measurement], float], uncertainty: float) -> list[Measurement]:
    """Returns the points that no other one improves in cost and in error; the cheapest, least exact one first.

    Errors below the uncertainty of the reference count as equal.
    """
    found: list[Measurement] = []
    for point in sorted(points, key=lambda p: (cost(p), max(p.error, uncertainty), len(p.settings), p.error)):
        if not found or max(point.error, uncertainty) < max(found[-1].error, uncertainty):
            found.append(point)
    return found


def choose(points: Sequence[Measurement], wish: Wish, uncertainty: float) -> Choice:
    """Chooses from at least one point. uncertainty: of the reference [m]"""
    along = front(points, wish.cost, uncertainty)
    fitting = [k for k, point in enumerate(along) if wish.fits(point, uncertainty)]
    cheapest = wish.cheapest if fitting else not wish.cheapest
    at = (fitting or range(len(along)))[0 if cheapest else -1]
    cheaper, more_exact = along[at - 1] if at else None, along[at + 1] if at + 1 < len(along) else None
    return Choice(along[at], bool(fitting), cheaper, more_exact)
